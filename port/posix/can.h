/* A CAN bus of the host, for telemetry alone: SocketCAN, or python-can's `udp_multicast` where there is none. */
#ifndef CAN_H
#define CAN_H

#include <stdbool.h>
#include <stdint.h>
#include <time.h>

#include "selfcal.h"

typedef struct {
    int handle;
    bool datagrams;      /* frames in msgpack, each a datagram; else SocketCAN's struct */
    int timeout_ms;      /* the bus may be full for this long */
    struct timespec due; /* when the bus is free again */
    const char *error;   /* why the bus is of no more use; NULL while it works */
} can_t;

/* Opens `bus`: a CAN device (vcan0), or the IPv4 multicast group and port 239.74.163.2:43113. NULL, or why it fails. */
const char *can_open(can_t *can, const char *bus, int timeout_ms);

/* Sends a frame when a bus of 500 kbit/s would have room for it. Datagrams stay on this machine. */
void can_send(can_t *can, const selfcal_frame_t *frame);

#endif
