/* Arm semihosting: the emulator's services (Semihosting for AArch32 and AArch64, section 7). */
#ifndef SEMIHOST_H
#define SEMIHOST_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Handle of a file opened for reading, binary; negative: it cannot be. */
int32_t semihost_open(const char *path);

/* Bytes read: fewer than `count` at the end of the file. */
size_t semihost_read(int32_t file, void *bytes, size_t count);

/* The words after `arg=` of -semihosting-config, with a space between; false if they do not fit. */
bool semihost_command_line(char *text, size_t size);

/* Wall clock, s, from some start. Only for giving up on an absent host: nothing that is computed may depend on it. */
uint32_t semihost_wall_s(void);

void semihost_print(const char *text);

/* Ends the emulator with this exit code. */
__attribute__((noreturn)) void semihost_exit(uint32_t code);

#endif
