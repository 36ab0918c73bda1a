#include "port.h"

#include <string.h>

unsigned port_axis(const char *name) {
    static const char *const names[PORT_AXES] = {"gx", "gy", "gz", "ax", "ay", "az"};
    unsigned at = 0;
    while (at < PORT_AXES && strcmp(name, names[at]) != 0) {
        at++;
    }
    return at;
}
