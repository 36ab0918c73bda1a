/* Telemetry on bxCAN: CAN1, RX PB8, TX PB9. Without commands no filter is active, so nothing is received (RM0090
 * 32.7.4). With commands one filter is, for the command's identifier alone.
 * Frames leave in the order they were taken (TXFP). Bus-off ends by itself after 128 x 11 recessive bits (ABOM). */
#include "board.h"
#include "command.h"
#include "stm32f405.h"

enum { MAILBOXES = 3 };

/* A frame that has found no free mailbox for so long sends what waits there to nowhere: nobody acknowledges, or the bus
 * is off, and old telemetry is worth less than new. */
enum { PATIENCE_MS = 100 };

static bool working;
static uint32_t dropped, refused_since_ms;
static bool refused;
static volatile uint32_t aborted, bus_offs;

uint32_t can_bit_timing(uint32_t pclk_hz, uint32_t bit_per_s) {
    uint32_t best = 0, best_error = UINT32_MAX;
    for (uint32_t quanta = 25; quanta >= 8U; quanta--) { /* 1 + TS1 + TS2, section 32.7.7 */
        if (bit_per_s == 0U || pclk_hz % (bit_per_s * quanta) != 0U) {
            continue;
        }
        const uint32_t prescaler = pclk_hz / (bit_per_s * quanta);
        const uint32_t ts2 = (quanta + 4U) / 8U;
        const uint32_t ts1 = quanta - 1U - ts2;
        if (prescaler < 1U || prescaler > 1024U || ts1 > 16U || ts2 > 8U) {
            continue;
        }
        const uint32_t point = (1U + ts1) * 1000U / quanta; /* CiA 601: 87.5 % */
        const uint32_t error = point > 875U ? point - 875U : 875U - point;
        if (error < best_error) {
            best_error = error;
            best = (ts2 - 1U) << CAN_BTR_TS2_POS | (ts1 - 1U) << CAN_BTR_TS1_POS | (prescaler - 1U); /* SJW: 1 */
        }
    }
    return best;
}

static bool await_initialisation(bool on) {
    const uint32_t start = clock_us32();
    while (((CAN_MSR & CAN_MSR_INAK) != 0U) != on) {
        if (clock_us32() - start > 20000U) { /* leaving waits for 11 recessive bits: 88 us at 125 kbit/s */
            return false;
        }
    }
    return true;
}

bool can_init(uint32_t bit_per_s) {
    const uint32_t timing = can_bit_timing(board_clock.pclk1_hz, bit_per_s);
    if (timing == 0U) {
        return false;
    }
    RCC_AHB1ENR |= RCC_AHB1ENR_GPIOB;
    RCC_APB1ENR |= RCC_APB1ENR_CAN1;
    (void)RCC_APB1ENR;
    GPIO_AFR(GPIOB, 8U) = (GPIO_AFR(GPIOB, 8U) & ~0xFFU) | 0x99U;
    GPIO_MODER(GPIOB) = (GPIO_MODER(GPIOB) & ~(0xFU << 16)) | 0xAU << 16;
    GPIO_PUPDR(GPIOB) = (GPIO_PUPDR(GPIOB) & ~(0x3U << 16)) | 0x1U << 16; /* no transceiver: recessive */

    CAN_MCR = CAN_MCR_INRQ | CAN_MCR_TXFP | CAN_MCR_ABOM; /* out of sleep, into initialisation */
    if (!await_initialisation(true)) {
        return false;
    }
    CAN_BTR = timing;
#ifdef APP_COMMAND_KEY
    CAN_FMR |= CAN_FMR_FINIT;
    CAN_FS1R |= BIT(0);   /* bank 0: one 32-bit filter ... */
    CAN_FM1R &= ~BIT(0);  /* ... of identifier and mask ... */
    CAN_FFA1R &= ~BIT(0); /* ... into FIFO 0 */
    CAN_F0R1 = COMMAND_ID << CAN_TIR_STID_POS;
    CAN_F0R2 = 0x7FFU << CAN_TIR_STID_POS | CAN_RIR_IDE | CAN_RIR_RTR;
    CAN_FA1R |= BIT(0);
    CAN_FMR &= ~CAN_FMR_FINIT;
#endif
    CAN_IER = CAN_IER_TMEIE | CAN_IER_BOFIE | CAN_IER_ERRIE;
    CAN_MCR = CAN_MCR_TXFP | CAN_MCR_ABOM;
    /* With the bus held dominant this does not come about yet; mailboxes may be filled all the same and go out when
     * it does. */
    (void)await_initialisation(false);
    irq_enable(IRQ_CAN1_TX);
    irq_enable(IRQ_CAN1_SCE);
    working = true;
    return true;
}

bool can_send(const selfcal_frame_t *frame) {
    if (!working) {
        dropped++;
        return true;
    }
    const uint32_t empty = CAN_TSR >> CAN_TSR_TME_POS & 0x7U;
    if (empty == 0U) {
        const uint32_t now = clock_ms();
        if (!refused) {
            refused = true;
            refused_since_ms = now;
        } else if (now - refused_since_ms > PATIENCE_MS) {
            refused = false;
            CAN_TSR = CAN_TSR_ABRQ(0) | CAN_TSR_ABRQ(1) | CAN_TSR_ABRQ(2);
        }
        return false;
    }
    refused = false;
    const uint32_t mailbox = (empty & 1U) != 0U ? 0U : (empty & 2U) != 0U ? 1U : 2U;
    const uint8_t *d = frame->data;
    CAN_TDTR(mailbox) = frame->length;
    CAN_TDLR(mailbox) = (uint32_t)d[0] | (uint32_t)d[1] << 8 | (uint32_t)d[2] << 16 | (uint32_t)d[3] << 24;
    CAN_TDHR(mailbox) = (uint32_t)d[4] | (uint32_t)d[5] << 8 | (uint32_t)d[6] << 16 | (uint32_t)d[7] << 24;
    CAN_TIR(mailbox) = (uint32_t)frame->id << CAN_TIR_STID_POS | CAN_TIR_TXRQ;
    return true;
}

bool can_sent(void) {
    return !working || (CAN_TSR >> CAN_TSR_TME_POS & 0x7U) == 0x7U;
}

void can_poll(void) {
#ifdef APP_COMMAND_KEY
    if ((CAN_RF0R & CAN_RF0R_FMP) == 0U) {
        return;
    }
    const uint32_t id = CAN_RI0R, length = CAN_RDT0R & CAN_RDTR_DLC, low = CAN_RDL0R, high = CAN_RDH0R;
    CAN_RF0R = CAN_RF0R_RFOM;
    if (length == 8U && id >> CAN_TIR_STID_POS == COMMAND_ID && (id & (CAN_RIR_IDE | CAN_RIR_RTR)) == 0U) {
        uint8_t data[8];
        for (unsigned i = 0; i < 4U; i++) {
            data[i] = (uint8_t)(low >> (8U * i));
            data[4U + i] = (uint8_t)(high >> (8U * i));
        }
        module_command(data);
    }
#endif
}

/* Wakes the main loop, which fills the mailbox. A request that ends without TXOK was aborted; one that was on the
 * bus then may still have been heard (section 32.7.1). */
void can_tx_handler(void) {
    const uint32_t ended = CAN_TSR;
    uint32_t clear = 0;
    for (uint32_t mailbox = 0; mailbox < MAILBOXES; mailbox++) {
        if ((ended & CAN_TSR_RQCP(mailbox)) != 0U) {
            clear |= CAN_TSR_RQCP(mailbox);
            aborted += (ended & CAN_TSR_TXOK(mailbox)) == 0U ? 1U : 0U;
        }
    }
    CAN_TSR = clear;
}

void can_error_handler(void) {
    if ((CAN_ESR & CAN_ESR_BOFF) != 0U) {
        bus_offs++;
    }
    CAN_MSR = BIT(2); /* ERRI, section 32.9.2: cleared by writing 1 */
}

void can_counters(wire_counters_t *counters) {
    counters->dropped = dropped + aborted;
    counters->bus_offs = bus_offs;
}
