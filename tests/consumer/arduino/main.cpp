/* Ten minutes of the sketch. */
#include <Arduino.h>

#include "sketch.cpp"

Port Serial;

int main() {
    setup();
    for (long i = 0; i < static_cast<long>(600.0F * SELFCAL_MODEL_RATE_HZ); i++) {
        loop();
    }
}
