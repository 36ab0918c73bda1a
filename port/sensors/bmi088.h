/* BMI088 over SPI: a gyroscope and an accelerometer, two chips in one case, each with its own chip select, FIFO and
 * clock. Data sheet BST-BMI088-DS001.
 *
 * A sample is a reading of the gyroscope, with an acceleration of up to three of its periods before. The two clocks
 * drift apart, by 1 % at most: an acceleration is then left out or taken twice, and the time remains the gyroscope's.
 * At 1000 Hz the accelerometer runs at 1600 Hz, else at the same rate.
 * The FIFOs hold 100 rates and 146 accelerations, so no interrupt is needed: a loop that comes back within 90 ms loses
 * nothing at 1 kHz. They have neither checksum nor stamp. After an overflow the gyroscope's begins anew, and the
 * processor's clock counts the missing samples.
 * The second chip select, the gyroscope's, is the board's reset line. Ranges are 2000 deg/s and 24 g. The part has no
 * offset registers. A start takes 0.4 s with both self-tests. */
#ifndef BMI088_H
#define BMI088_H

#include "sensor.h"

/* True for 100, 200, 400 and 1000 Hz, to 0.1 %. Constant where the rate is. */
#define BMI088_NEAR(rate_hz, nominal) ((rate_hz) >= 0.999F * (nominal) && (rate_hz) <= 1.001F * (nominal))
#define bmi088_has_rate(rate_hz)                                                                                       \
    (BMI088_NEAR(rate_hz, 100.0F) || BMI088_NEAR(rate_hz, 200.0F) || BMI088_NEAR(rate_hz, 400.0F) ||                   \
     BMI088_NEAR(rate_hz, 1000.0F))
#define bmi088_rates "100, 200, 400 or 1000 Hz"
#define bmi088_bus spi_bus
#define bmi088_has_supply 0

extern const sensor_t bmi088;

#endif
