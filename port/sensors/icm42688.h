/* ICM-42688-P over SPI: six axes in 20 bits from its FIFO, with temperature and timestamps.
 * Data sheet DS-000347. Limits of the self-test, and that a timestamp's unit is its PLL's: the maker's own driver.
 *
 * The sensor gathers packets of 20 bytes, 102 at most. The main loop reads them, so no interrupt is needed. A loop that
 * comes back within 100 ms loses nothing at 1 kHz. Packets follow each other: a timestamp that is not one period after
 * the last betrays a damaged packet. After an overflow, timestamps and the processor's clock count the missing samples.
 * A packet has no checksum, and the FIFO gives it once: a wrong bit in a reading passes. A wrong bit in a header, a
 * timestamp or an unused bit costs its packet.
 * In 20 bits the ranges are 2000 deg/s and 16 g: 1/131.072 deg/s and 1/8192 g a step.
 * A start takes 0.6 s with its self-test. Offsets: 64 deg/s and 1 g in steps of 1/32 deg/s and 0.5 mg. */
#ifndef ICM42688_H
#define ICM42688_H

#include "sensor.h"

/* True for 25, 50, 100, 200, 500 and 1000 Hz, to 0.1 %. Constant where the rate is. */
#define ICM42688_NEAR(rate_hz, nominal) ((rate_hz) >= 0.999F * (nominal) && (rate_hz) <= 1.001F * (nominal))
#define icm42688_has_rate(rate_hz)                                                                                     \
    (ICM42688_NEAR(rate_hz, 25.0F) || ICM42688_NEAR(rate_hz, 50.0F) || ICM42688_NEAR(rate_hz, 100.0F) ||               \
     ICM42688_NEAR(rate_hz, 200.0F) || ICM42688_NEAR(rate_hz, 500.0F) || ICM42688_NEAR(rate_hz, 1000.0F))
#define icm42688_rates "25, 50, 100, 200, 500 or 1000 Hz"
#define icm42688_bus spi_bus
#define icm42688_has_supply 0

extern const sensor_t icm42688;

#endif
