#include "semihost.h"

#include <string.h>

enum {
    SYS_OPEN = 0x01,
    SYS_WRITE0 = 0x04,
    SYS_READ = 0x06,
    SYS_TIME = 0x11,
    SYS_GET_CMDLINE = 0x15,
    SYS_EXIT_EXTENDED = 0x20,
    OPEN_RB = 1,
    ADP_STOPPED_APPLICATION_EXIT = 0x20026
};

static uint32_t call(uint32_t operation, const void *argument) {
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

int32_t semihost_open(const char *path) {
    const uint32_t block[3] = {(uint32_t)path, OPEN_RB, strlen(path)};
    return (int32_t)call(SYS_OPEN, block);
}

size_t semihost_read(int32_t file, void *bytes, size_t count) {
    const uint32_t block[3] = {(uint32_t)file, (uint32_t)bytes, count};
    const uint32_t left = call(SYS_READ, block); /* what was not read */
    return left <= count ? count - left : 0U;
}

bool semihost_command_line(char *text, size_t size) {
    uint32_t block[2] = {(uint32_t)text, size};
    return call(SYS_GET_CMDLINE, block) == 0U;
}

uint32_t semihost_wall_s(void) {
    return call(SYS_TIME, NULL);
}

void semihost_print(const char *text) {
    (void)call(SYS_WRITE0, text);
}

void semihost_exit(uint32_t code) {
    const uint32_t block[2] = {ADP_STOPPED_APPLICATION_EXIT, code};
    for (;;) {
        (void)call(SYS_EXIT_EXTENDED, block);
    }
}
