/* An MPU-6050 on the bus, on this machine: at rest, with noise of known size. Registers as in RM-MPU-6000A. */
#ifndef WIRE_H
#define WIRE_H

#include <Arduino.h>

/* Biases in counts, and the deviation of a sample. */
static const double SENSOR_MEAN[6] = {196.5, -655.0, 40.0, 0.0, 120.0, 16384.0};
static const double SENSOR_SD[6] = {6.0, 6.0, 6.0, 40.0, 40.0, 40.0};

struct Bus {
    uint8_t registers[128] = {};
    uint8_t place = 0, written = 0;
    int next = 0;

    void begin() {}
    void setClock(long) {}
    void beginTransmission(int) { written = 0; }
    void write(uint8_t value) {
        if (written++ == 0) {
            place = value;
        } else {
            registers[place++] = value;
        }
    }
    int endTransmission(bool = true) { return 0; }
    uint8_t requestFrom(uint8_t address, uint8_t count) {
        next = place;
        registers[0x3A] = registers[0x38]; // a sample is there if its bit is enabled
        for (int axis = 0; place == 0x3B && axis < 6; axis++) {
            double sum = -6.0;
            for (int i = 0; i < 12; i++) {
                sum += std::rand() / (RAND_MAX + 1.0);
            }
            const int from = axis < 3 ? 0x43 + 2 * axis : 0x3B + 2 * (axis - 3); // gyro, accelerometer
            const double value = SENSOR_MEAN[axis] + SENSOR_SD[axis] * sum;
            const unsigned bits = static_cast<unsigned>(static_cast<int>(value < 0.0 ? value - 0.5 : value + 0.5));
            registers[from] = static_cast<uint8_t>(bits >> 8);
            registers[from + 1] = static_cast<uint8_t>(bits);
        }
        const bool awake = registers[0x6B] == 1 && registers[0x1A] == 3 && registers[0x19] == 9;
        return address == 0x68 && (awake || place != 0x3B) ? count : 0;
    }
    int read() { return registers[next++]; }
};

inline Bus Wire;

#endif
