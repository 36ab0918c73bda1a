#include "count.h"

static void print_name(const char *kind, const char *name) {
    image_print(kind);
    image_print(" ");
    image_print(name);
    image_print(" ");
}

void count_add(taken_t *sum, taken_t part) {
    sum->ticks += part.ticks;
    sum->rounds += part.rounds;
    sum->parts += part.parts;
}

void count_print_value(const char *name, uint64_t number) {
    print_name("value", name);
    image_print_number(number);
    image_print("\n");
}

void count_print(const char *name, taken_t taken, uint64_t per) {
    print_name("count", name);
    image_print_number(taken.ticks);
    image_print(" ");
    image_print_number(taken.parts);
    image_print(" ");
    image_print_number(taken.rounds);
    image_print(" ");
    image_print_number(per);
    image_print("\n");
}

void count_print_empty(void) {
    const image_time_t start = image_now();
    const taken_t taken = count_since(start);
    count_print("clock.empty", taken, 1U);
}

void count_require(bool holds, const char *what) {
    if (!holds) {
        print_name("failed", what);
        image_print("\n");
        image_exit(2U);
    }
}
