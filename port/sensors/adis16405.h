/* ADIS16405: six axes over SPI, with data-ready.
 *
 * READING  The sensor raises data-ready once a sample. The driver then reads the burst twice. A burst has no checksum,
 *   but the output registers stand still until the next sample: damage on the wires shows as a difference between the
 *   two readings. A sample is delivered only if
 *   - the first reading has ND (new data) set and EA (error/alarm) clear on all six inertial channels,
 *   - the second one has the same 14 bits everywhere,
 *   - XGYRO_OUT has not lost its sign bit (known anomaly of the part: a step of +2^13 LSB).
 *   Everything else is counted, and time passes: the next delivered sample tells how many are missing before it, by
 *   the clock and the sensor's own sample period, which is tracked.
 * SETTINGS  They are read back every ten seconds, fifty at most. So they are after a pause, and when samples come too
 *   fast, before a sample is taken: something else may have reset the sensor.
 * TIME  Nothing blocks for longer than a register access, about 70 us each (350 us in the sensor's slow mode): some
 *   ten of them in a row, a hundred when the sensor is started.
 * OFFSETS  50 deg/s and 6.8 g in steps of 0.0125 deg/s and 3.33 mg. No XGYRO_OFF below 0, so a positive x bias stays.
 * SPI  Data sheet, timing specifications: with SMPL_PRD of 0x0A and more (n > 10) SCK is 300 kHz at most and frames lie
 *   75 us apart. Below that 2 MHz, 1 MHz in a burst, and 9 us.
 *
 * Registers and bits: ADIS16400/ADIS16405 data sheet, table 8 and the register tables after it. */
#ifndef ADIS16405_H
#define ADIS16405_H

#include "sensor.h"

/* True if 1638.4 / n Hz, n = 2 .. 128, make the rate to 0.1 %. Constant where the rate is. (Two bursts, 634 us, must
 * fit a sample period: no n = 1.) */
#define ADIS16405_OFF(rate_hz) (1638.4F / (rate_hz) - (float)(uint32_t)(1638.4F / (rate_hz) + 0.5F))
#define adis16405_has_rate(rate_hz)                                                                                    \
    (1638.4F / (rate_hz) >= 1.5F && 1638.4F / (rate_hz) < 128.5F && ADIS16405_OFF(rate_hz) <= 1.6384F / (rate_hz) &&   \
     ADIS16405_OFF(rate_hz) >= -1.6384F / (rate_hz))
#define adis16405_rates "1638.4 Hz / n, n = 2 to 128"
#define adis16405_bus spi_bus
#define adis16405_has_supply 1

extern const sensor_t adis16405;

#endif
