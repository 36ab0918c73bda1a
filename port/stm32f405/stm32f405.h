/* The registers of the STM32F405 that this firmware uses, by hand from RM0090 (reference manual, revision 21) and
 * PM0214 (Cortex-M4 programming manual); the section is named at each block. Older revisions have the same sections,
 * and some tables numbered one lower. Names are the manuals'. */
#ifndef STM32F405_H
#define STM32F405_H

#include <stdint.h>

#define REG32(address) (*(volatile uint32_t *)(uintptr_t)(address))
#define BIT(n) (1UL << (n))

/* --- RCC, RM0090 section 7.3 --- */
#define RCC_CR REG32(0x40023800U)
#define RCC_PLLCFGR REG32(0x40023804U)
#define RCC_CFGR REG32(0x40023808U)
#define RCC_AHB1ENR REG32(0x40023830U)
#define RCC_AHB2ENR REG32(0x40023834U)
#define RCC_APB1ENR REG32(0x40023840U)
#define RCC_APB2ENR REG32(0x40023844U)
#define RCC_CSR REG32(0x40023874U)
#define RCC_CR_HSION BIT(0)
#define RCC_CR_HSIRDY BIT(1)
#define RCC_CR_HSEON BIT(16)
#define RCC_CR_HSERDY BIT(17)
#define RCC_CR_CSSON BIT(19)
#define RCC_CR_PLLON BIT(24)
#define RCC_CR_PLLRDY BIT(25)
#define RCC_PLLCFGR_N_POS 6U
#define RCC_PLLCFGR_P_POS 16U
#define RCC_PLLCFGR_SRC_HSE BIT(22)
#define RCC_PLLCFGR_Q_POS 24U
#define RCC_CFGR_SW_MASK 3U
#define RCC_CFGR_SW_PLL 2U
#define RCC_CFGR_SWS_POS 2U
#define RCC_CFGR_PPRE1_DIV4 (5U << 10)
#define RCC_CFGR_PPRE2_DIV4 (5U << 13)
#define RCC_AHB1ENR_GPIOA BIT(0)
#define RCC_AHB1ENR_GPIOB BIT(1)
#define RCC_AHB1ENR_DMA2 BIT(22)
#define RCC_AHB2ENR_RNG BIT(6)
#define RCC_APB1ENR_TIM2 BIT(0)
#define RCC_APB1ENR_CAN1 BIT(25)
#define RCC_APB1ENR_PWR BIT(28)
#define RCC_APB2ENR_USART1 BIT(4)
#define RCC_APB2ENR_SPI1 BIT(12)
#define RCC_APB2ENR_SYSCFG BIT(14)
#define RCC_CSR_LSION BIT(0)
#define RCC_CSR_LSIRDY BIT(1)
#define RCC_CSR_RMVF BIT(24)
#define RCC_CSR_BORRSTF BIT(25)
#define RCC_CSR_PINRSTF BIT(26)
#define RCC_CSR_PORRSTF BIT(27)
#define RCC_CSR_SFTRSTF BIT(28)
#define RCC_CSR_IWDGRSTF BIT(29)
#define RCC_CSR_WWDGRSTF BIT(30)
#define RCC_CSR_LPWRRSTF BIT(31)

/* --- PWR, RM0090 section 5.4 --- */
#define PWR_CR REG32(0x40007000U)
#define PWR_CR_VOS BIT(14) /* scale 1: needed at 168 MHz */

/* --- Flash, RM0090 section 3.9 --- */
#define FLASH_ACR REG32(0x40023C00U)
#define FLASH_KEYR REG32(0x40023C04U)
#define FLASH_SR REG32(0x40023C0CU)
#define FLASH_CR REG32(0x40023C10U)
#define FLASH_ACR_LATENCY_5WS 5U /* section 3.5.1: 150 < HCLK <= 168 MHz at 2.7 to 3.6 V */
#define FLASH_ACR_PRFTEN BIT(8)
#define FLASH_ACR_ICEN BIT(9)
#define FLASH_ACR_DCEN BIT(10)
#define FLASH_ACR_DCRST BIT(12)
#define FLASH_KEY1 0x45670123U
#define FLASH_KEY2 0xCDEF89ABU
#define FLASH_SR_OPERR BIT(1)
#define FLASH_SR_WRPERR BIT(4)
#define FLASH_SR_PGAERR BIT(5)
#define FLASH_SR_PGPERR BIT(6)
#define FLASH_SR_PGSERR BIT(7)
#define FLASH_SR_BSY BIT(16)
#define FLASH_CR_PG BIT(0)
#define FLASH_CR_SER BIT(1)
#define FLASH_CR_SNB_POS 3U
#define FLASH_CR_PSIZE_X32 (2U << 8)
#define FLASH_CR_STRT BIT(16)
#define FLASH_CR_LOCK BIT(31)

/* --- GPIO, RM0090 section 8.4 --- */
#define GPIOA 0x40020000U
#define GPIOB 0x40020400U
#define GPIO_MODER(port) REG32((port) + 0x00U)
#define GPIO_OTYPER(port) REG32((port) + 0x04U)
#define GPIO_OSPEEDR(port) REG32((port) + 0x08U)
#define GPIO_PUPDR(port) REG32((port) + 0x0CU)
#define GPIO_IDR(port) REG32((port) + 0x10U)
#define GPIO_BSRR(port) REG32((port) + 0x18U)
#define GPIO_AFR(port, pin) REG32((port) + 0x20U + 4U * ((pin) / 8U))

/* --- SYSCFG and EXTI, RM0090 sections 9.2 and 12.3 --- */
#define SYSCFG_EXTICR1 REG32(0x40013808U)
#define EXTI_IMR REG32(0x40013C00U)
#define EXTI_RTSR REG32(0x40013C08U)
#define EXTI_PR REG32(0x40013C14U)

/* --- DMA, RM0090 section 10.5 --- */
#define DMA2 0x40026400U
#define DMA_LISR REG32(DMA2 + 0x00U)
#define DMA_LIFCR REG32(DMA2 + 0x08U)
#define DMA_SCR(stream) REG32(DMA2 + 0x10U + 0x18U * (stream))
#define DMA_SNDTR(stream) REG32(DMA2 + 0x14U + 0x18U * (stream))
#define DMA_SPAR(stream) REG32(DMA2 + 0x18U + 0x18U * (stream))
#define DMA_SM0AR(stream) REG32(DMA2 + 0x1CU + 0x18U * (stream))
#define DMA_SFCR(stream) REG32(DMA2 + 0x24U + 0x18U * (stream))
#define DMA_SCR_EN BIT(0)
#define DMA_SCR_TEIE BIT(2)
#define DMA_SCR_TCIE BIT(4)
#define DMA_SCR_TO_PERIPHERAL BIT(6)
#define DMA_SCR_MINC BIT(10)
#define DMA_SCR_PL_HIGH (2U << 16)
#define DMA_SCR_CHSEL_POS 25U
#define DMA_LISR_TEIF0 BIT(3)
#define DMA_LISR_TCIF0 BIT(5)
#define DMA_LISR_STREAM0 0x3DU         /* every flag of stream 0 ... */
#define DMA_LISR_STREAM3 (0x3DU << 22) /* ... and of stream 3 */

/* --- TIM2 to TIM5, RM0090 section 18.4 --- */
#define TIM2_CR1 REG32(0x40000000U)
#define TIM2_EGR REG32(0x40000014U)
#define TIM2_CNT REG32(0x40000024U)
#define TIM2_PSC REG32(0x40000028U)
#define TIM2_ARR REG32(0x4000002CU)
#define TIM_CR1_CEN BIT(0)
#define TIM_EGR_UG BIT(0)

/* --- IWDG, RM0090 section 21.4 --- */
#define IWDG_KR REG32(0x40003000U)
#define IWDG_PR REG32(0x40003004U)
#define IWDG_RLR REG32(0x40003008U)
#define IWDG_SR REG32(0x4000300CU)
#define IWDG_KR_RELOAD 0xAAAAU
#define IWDG_KR_ACCESS 0x5555U
#define IWDG_KR_START 0xCCCCU
#define IWDG_PR_DIV256 6U

/* --- SPI, RM0090 section 28.5 --- */
#define SPI1_CR1 REG32(0x40013000U)
#define SPI1_CR2 REG32(0x40013004U)
#define SPI1_SR REG32(0x40013008U)
#define SPI1_DR_ADDRESS 0x4001300CU
#define SPI1_DR REG32(SPI1_DR_ADDRESS)
#define SPI_CR1_CPHA BIT(0)
#define SPI_CR1_CPOL BIT(1)
#define SPI_CR1_MSTR BIT(2)
#define SPI_CR1_BR_POS 3U
#define SPI_CR1_SPE BIT(6)
#define SPI_CR1_SSI BIT(8)
#define SPI_CR1_SSM BIT(9)
#define SPI_CR2_RXDMAEN BIT(0)
#define SPI_CR2_TXDMAEN BIT(1)
#define SPI_SR_RXNE BIT(0)
#define SPI_SR_TXE BIT(1)
#define SPI_SR_BSY BIT(7)

/* --- USART, RM0090 section 30.6 --- */
#define USART1_SR REG32(0x40011000U)
#define USART1_DR REG32(0x40011004U)
#define USART1_BRR REG32(0x40011008U)
#define USART1_CR1 REG32(0x4001100CU)
#define USART_SR_FE BIT(1)
#define USART_SR_NF BIT(2)
#define USART_SR_ORE BIT(3)
#define USART_SR_RXNE BIT(5)
#define USART_SR_TC BIT(6)
#define USART_SR_TXE BIT(7)
#define USART_CR1_RE BIT(2)
#define USART_CR1_TE BIT(3)
#define USART_CR1_RXNEIE BIT(5)
#define USART_CR1_TXEIE BIT(7)
#define USART_CR1_UE BIT(13)

/* --- bxCAN, RM0090 section 32.9 --- */
#define CAN1 0x40006400U
#define CAN_MCR REG32(CAN1 + 0x000U)
#define CAN_MSR REG32(CAN1 + 0x004U)
#define CAN_TSR REG32(CAN1 + 0x008U)
#define CAN_RF0R REG32(CAN1 + 0x00CU)
#define CAN_IER REG32(CAN1 + 0x014U)
#define CAN_ESR REG32(CAN1 + 0x018U)
#define CAN_BTR REG32(CAN1 + 0x01CU)
#define CAN_TIR(mailbox) REG32(CAN1 + 0x180U + 0x10U * (mailbox))
#define CAN_TDTR(mailbox) REG32(CAN1 + 0x184U + 0x10U * (mailbox))
#define CAN_TDLR(mailbox) REG32(CAN1 + 0x188U + 0x10U * (mailbox))
#define CAN_TDHR(mailbox) REG32(CAN1 + 0x18CU + 0x10U * (mailbox))
#define CAN_RI0R REG32(CAN1 + 0x1B0U)
#define CAN_RDT0R REG32(CAN1 + 0x1B4U)
#define CAN_RDL0R REG32(CAN1 + 0x1B8U)
#define CAN_RDH0R REG32(CAN1 + 0x1BCU)
#define CAN_FMR REG32(CAN1 + 0x200U)
#define CAN_FM1R REG32(CAN1 + 0x204U)
#define CAN_FS1R REG32(CAN1 + 0x20CU)
#define CAN_FFA1R REG32(CAN1 + 0x214U)
#define CAN_FA1R REG32(CAN1 + 0x21CU)
#define CAN_F0R1 REG32(CAN1 + 0x240U)
#define CAN_F0R2 REG32(CAN1 + 0x244U)
#define CAN_MCR_INRQ BIT(0)
#define CAN_MCR_SLEEP BIT(1)
#define CAN_MCR_TXFP BIT(2)
#define CAN_MCR_ABOM BIT(6)
#define CAN_MCR_RESET BIT(15)
#define CAN_MSR_INAK BIT(0)
#define CAN_TSR_RQCP(mailbox) BIT(8U * (mailbox))
#define CAN_TSR_TXOK(mailbox) BIT(8U * (mailbox) + 1U)
#define CAN_TSR_ABRQ(mailbox) BIT(8U * (mailbox) + 7U)
#define CAN_TSR_TME_POS 26U
#define CAN_RF0R_FMP 3U
#define CAN_RF0R_RFOM BIT(5)
#define CAN_RIR_IDE BIT(2)
#define CAN_RIR_RTR BIT(1)
#define CAN_RDTR_DLC 15U
#define CAN_FMR_FINIT BIT(0)
#define CAN_IER_TMEIE BIT(0)
#define CAN_IER_BOFIE BIT(10)
#define CAN_IER_ERRIE BIT(15)
#define CAN_ESR_BOFF BIT(2)
#define CAN_BTR_TS1_POS 16U
#define CAN_BTR_TS2_POS 20U
#define CAN_TIR_TXRQ BIT(0)
#define CAN_TIR_STID_POS 21U

/* --- RNG, RM0090 section 24.4 --- */
#define RNG_CR REG32(0x50060800U)
#define RNG_SR REG32(0x50060804U)
#define RNG_DR REG32(0x50060808U)
#define RNG_CR_RNGEN BIT(2)
#define RNG_SR_DRDY BIT(0)
#define RNG_SR_CECS BIT(1) /* clock error */
#define RNG_SR_SECS BIT(2) /* seed error */

/* --- core: SysTick PM0214 4.5, NVIC 4.3, SCB 4.4, FPU 4.6 --- */
#define SYST_CSR REG32(0xE000E010U)
#define SYST_RVR REG32(0xE000E014U)
#define SYST_CVR REG32(0xE000E018U)
#define SYST_CSR_RUN 7U /* processor clock, interrupt, on */
#define NVIC_ISER(n) REG32(0xE000E100U + 4U * (n))
#define NVIC_IPR(n) REG32(0xE000E400U + 4U * (n))
#define SCB_VTOR REG32(0xE000ED08U)
#define SCB_AIRCR REG32(0xE000ED0CU)
#define SCB_SHCSR REG32(0xE000ED24U)
#define SCB_CFSR REG32(0xE000ED28U)
#define SCB_CPACR REG32(0xE000ED88U)
#define SCB_AIRCR_SYSRESETREQ (0x05FA0000U | BIT(2))
#define SCB_CPACR_FPU (0xFU << 20)

/* Interrupt numbers, RM0090 table 62. */
enum { IRQ_EXTI0 = 6, IRQ_CAN1_TX = 19, IRQ_CAN1_SCE = 22, IRQ_USART1 = 37, IRQ_DMA2_STREAM0 = 56, IRQ_COUNT = 82 };

static inline void irq_enable(uint32_t number) {
    NVIC_ISER(number / 32U) = BIT(number % 32U);
}

/* Its handler is broken into by those of interrupts that do not give way (priority 1 of 0 to 15, PM0214 4.3.7). */
static inline void irq_give_way(uint32_t number) {
    NVIC_IPR(number / 4U) |= 0x10U << 8U * (number % 4U);
}

static inline void irq_off(void) {
    __asm__ volatile("cpsid i" : : : "memory");
}

static inline void irq_on(void) {
    __asm__ volatile("cpsie i" : : : "memory");
}

#endif
