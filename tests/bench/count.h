/* Counting on a bench image, and what is printed of it for bench.py:
 *   count NAME TICKS PARTS ROUNDS PER   of SysTick, in PARTS measurements (ROUNDS: image_time_t), for PER units of work
 *   value NAME NUMBER
 */
#ifndef COUNT_H
#define COUNT_H

#include "image.h"

#include <stdbool.h>
#include <stdint.h>

/* Some measurements together. */
typedef struct {
    uint64_t ticks;
    uint32_t rounds, parts;
} taken_t;

/* Inline: nothing comes between what is measured and the clock. */
static inline taken_t count_since(image_time_t start) {
    const image_time_t now = image_now();
    const taken_t taken = {now.ticks - start.ticks, now.rounds - start.rounds, 1U};
    return taken;
}

void count_add(taken_t *sum, taken_t part);
void count_print(const char *name, taken_t taken, uint64_t per);
void count_print_value(const char *name, uint64_t number);
/* What every measurement has in it by being one. */
void count_print_empty(void);

/* Unless it `holds`, the image ends with exit code 2 and says what did not. */
void count_require(bool holds, const char *what);

#endif
