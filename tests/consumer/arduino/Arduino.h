/* What the sketch takes from Arduino's core, on this machine. */
#ifndef ARDUINO_H
#define ARDUINO_H

#include <cstdint>
#include <cstdio>
#include <cstdlib>

struct Port {
    void begin(long) {}
    void print(const char *text) { std::fputs(text, stdout); }
    void print(double value, int digits) { std::printf("%.*f", digits, value); }
    void println(const char *text) { std::puts(text); }
    void println(double value, int digits) { std::printf("%.*f\n", digits, value); }
};

extern Port Serial;
inline long random(long below) {
    return std::rand() % below;
}

#endif
