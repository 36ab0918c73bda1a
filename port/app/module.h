/* A module: the application with its sensor, saved state and watchdog. A board gives the rest as callbacks.
 * The main() of every board with a sensor ends in module_run(). One a program. */
#ifndef MODULE_H
#define MODULE_H

#include "app.h"
#include "sensor.h"
#include "slots.h"

/* As in selfcal.dbc. */
typedef enum {
    RESET_UNKNOWN = 0,
    RESET_POWER_ON = 1, /* power, or brown-out */
    RESET_PIN = 2,
    RESET_SOFTWARE = 3,
    RESET_WATCHDOG = 4,
    RESET_FAULT = 5, /* software reset after a fault of the processor */
    RESET_LOW_POWER = 6
} reset_cause_t;

typedef struct {
    const slots_memory_t *memory;
    uint32_t report_ms;                         /* between reports of all axes */
    uint32_t (*time_ms)(void);                  /* since start, modulo 2^32 */
    uint32_t (*ticks)(void);                    /* goes up each millisecond that interrupts are served */
    bool (*send)(const selfcal_frame_t *frame); /* as port_t's */
    bool (*sent)(void);                         /* all frames that it took have left */
    void (*poll)(void);                   /* takes what came by the wire, and gives commands to module_command() */
    void (*sleep)(void);                  /* until an interrupt of the sensor or the wire, or the next millisecond */
    void (*feed)(void);                   /* the watchdog, whose time is longer than an erase of the memory takes */
    void (*tell)(selfcal_module_t *told); /* reset cause, fault address, clock, counters of the wire */
    bool (*random)(uint32_t *number);     /* for commands */
    void (*restart)(void);
} module_board_t;

/* Returns only if the model is not one for this sensor. */
void module_run(const module_board_t *board);

/* A frame of message COMMAND came. Built in with APP_COMMAND_KEY. */
void module_command(const uint8_t data[8]);

#endif
