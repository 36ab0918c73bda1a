/* MPU-6050 over I2C at address 0x68: six axes in 16 bits from its FIFO, with temperature. An MPU-6000 by I2C too.
 * Register map RM-MPU-6000A, revision 4.2; product specification PS-MPU-6000A, revision 3.4.
 *
 * The sensor gathers packets of 14 bytes, 73 at most, at 1 kHz over a whole number. The main loop reads them, so no
 * interrupt is needed: a loop that comes back within 300 ms loses nothing at 200 Hz. A packet has no checksum and no
 * stamp. After an overflow, or a transfer that was broken off, the FIFO is emptied and the processor's clock counts the
 * missing samples: to one sample while the two clocks agree within 1 %.
 * Ranges are 250 deg/s and 2 g: 1/131 deg/s and 1/16384 g a step. The part has no offset registers that are documented.
 * A start takes 0.7 s with its self-test (register map, 4.1 to 4.5). */
#ifndef MPU6050_H
#define MPU6050_H

#include "sensor.h"

/* True for 25, 50, 100, 125 and 200 Hz, to 0.1 %. Constant where the rate is. */
#define MPU6050_NEAR(rate_hz, nominal) ((rate_hz) >= 0.999F * (nominal) && (rate_hz) <= 1.001F * (nominal))
#define mpu6050_has_rate(rate_hz)                                                                                      \
    (MPU6050_NEAR(rate_hz, 25.0F) || MPU6050_NEAR(rate_hz, 50.0F) || MPU6050_NEAR(rate_hz, 100.0F) ||                  \
     MPU6050_NEAR(rate_hz, 125.0F) || MPU6050_NEAR(rate_hz, 200.0F))
#define mpu6050_rates "25, 50, 100, 125 or 200 Hz"
#define mpu6050_bus i2c_bus
#define mpu6050_has_supply 0

extern const sensor_t mpu6050;

#endif
