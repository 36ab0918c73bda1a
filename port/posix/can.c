#define _DEFAULT_SOURCE /* struct ifreq, struct ip_mreq */
#define _XOPEN_SOURCE 600

#include "can.h"

#include <arpa/inet.h>
#include <errno.h>
#include <net/if.h>
#include <netinet/in.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#ifdef __linux__
#include <linux/can.h>
#include <linux/can/raw.h>
#endif

/* 135 bits at 500 kbit/s: a frame of 8 bytes with every stuff bit, and the gap after it. */
enum { FRAME_NS = 270000, SLACK_NS = 1000000, SECOND_NS = 1000000000 };

static const char *open_group(can_t *can, const char *group, const char *port) {
    struct sockaddr_in to = {.sin_family = AF_INET};
    char *end;
    const long number = strtol(port, &end, 10);
    if (inet_pton(AF_INET, group, &to.sin_addr) != 1 || !IN_MULTICAST(ntohl(to.sin_addr.s_addr)) || end == port ||
        *end != '\0' || number < 1 || number > 65535) {
        return "wants a multicast group and a port: 239.74.163.2:43113";
    }
    to.sin_port = htons((uint16_t)number);
    const unsigned char hops = 0;
    can->datagrams = true;
    can->handle = socket(AF_INET, SOCK_DGRAM, 0);
    if (can->handle < 0 || setsockopt(can->handle, IPPROTO_IP, IP_MULTICAST_TTL, &hops, sizeof hops) != 0 ||
        connect(can->handle, (struct sockaddr *)&to, sizeof to) != 0) {
        return strerror(errno);
    }
    return NULL;
}

static const char *open_device(can_t *can, const char *name) {
#ifdef __linux__
    struct ifreq device;
    memset(&device, 0, sizeof device);
    if (strlen(name) >= sizeof device.ifr_name) {
        return "no such CAN device";
    }
    memcpy(device.ifr_name, name, strlen(name));
    can->handle = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (can->handle < 0) {
        return errno == EAFNOSUPPORT ? "this system has no SocketCAN" : strerror(errno);
    }
    if (ioctl(can->handle, SIOCGIFINDEX, &device) != 0) {
        return "no such CAN device";
    }
    struct sockaddr_can address;
    memset(&address, 0, sizeof address);
    address.can_family = AF_CAN;
    address.can_ifindex = device.ifr_ifindex;
    return bind(can->handle, (struct sockaddr *)&address, sizeof address) == 0 ? NULL : strerror(errno);
#else
    (void)can;
    (void)name;
    return "this system has no SocketCAN";
#endif
}

const char *can_open(can_t *can, const char *bus, int timeout_ms) {
    char group[sizeof "255.255.255.255"];
    memset(can, 0, sizeof *can);
    can->timeout_ms = timeout_ms;
    const char *colon = strchr(bus, ':');
    if (colon == NULL) {
        can->error = open_device(can, bus);
    } else if ((size_t)(colon - bus) < sizeof group) {
        memcpy(group, bus, (size_t)(colon - bus));
        group[colon - bus] = '\0';
        can->error = open_group(can, group, colon + 1);
    } else {
        can->error = "no such group";
    }
    (void)clock_gettime(CLOCK_MONOTONIC, &can->due);
    return can->error;
}

/* Nanoseconds from `from` to `to`; a second at most either way. */
static long between(const struct timespec *from, const struct timespec *to) {
    const long long seconds = (long long)to->tv_sec - (long long)from->tv_sec;
    return seconds > 1    ? SECOND_NS
           : seconds < -1 ? -SECOND_NS
                          : (long)(seconds * SECOND_NS + (to->tv_nsec - from->tv_nsec));
}

/* Waits until the frames before have passed, give or take a millisecond: sleeps are coarser than frames. */
static void await_bus(can_t *can) {
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    const long ahead = between(&now, &can->due);
    if (ahead <= 0) {
        can->due = now;
    } else if (ahead > SLACK_NS) {
        const struct timespec wait = {.tv_sec = 0, .tv_nsec = ahead < SECOND_NS ? ahead : SECOND_NS - 1};
        (void)nanosleep(&wait, NULL);
    }
    can->due.tv_nsec += FRAME_NS;
    if (can->due.tv_nsec >= SECOND_NS) {
        can->due.tv_nsec -= SECOND_NS;
        can->due.tv_sec++;
    }
}

/* As python-can's udp_multicast packs a frame: a msgpack map of its fields. */
static size_t pack(const selfcal_frame_t *frame, unsigned char bytes[64]) {
    /* clang-format off */
    static const unsigned char head[] = "\x84\xAE" "arbitration_id" "\xCD";
    static const unsigned char body[] = "\xAE" "is_extended_id" "\xC2\xA3" "dlc" "\x08\xA4" "data" "\xC4\x08";
    /* clang-format on */
    size_t at = sizeof head - 1U;
    memcpy(bytes, head, at);
    bytes[at++] = (unsigned char)(frame->id >> 8);
    bytes[at++] = (unsigned char)(frame->id & 0xFFU);
    memcpy(bytes + at, body, sizeof body - 1U);
    at += sizeof body - 1U;
    memcpy(bytes + at, frame->data, sizeof frame->data);
    return at + sizeof frame->data;
}

void can_send(can_t *can, const selfcal_frame_t *frame) {
    unsigned char packed[64];
    const void *bytes = packed;
    size_t length = 0;
#ifdef __linux__
    struct can_frame sent;
    if (!can->datagrams) {
        memset(&sent, 0, sizeof sent);
        sent.can_id = frame->id;
        sent.can_dlc = (uint8_t)sizeof frame->data;
        memcpy(sent.data, frame->data, sizeof frame->data);
        bytes = &sent;
        length = sizeof sent;
    }
#endif
    if (can->datagrams) {
        length = pack(frame, packed);
    }
    if (can->error != NULL) {
        return;
    }
    await_bus(can);
    for (int waited_ms = 0; write(can->handle, bytes, length) != (ssize_t)length; waited_ms++) {
        if (errno == ECONNREFUSED) { /* of a datagram before: nobody listens, as on a bus */
            return;
        }
        if ((errno != ENOBUFS && errno != EAGAIN && errno != EINTR) || waited_ms >= can->timeout_ms) {
            can->error = strerror(errno);
            return;
        }
        (void)poll(NULL, 0, 1);
    }
}
