/* Commands over the telemetry's wire: the COMMAND message of selfcal.dbc, built in only with APP_COMMAND_KEY.
 *
 * PROTOCOL  The host asks for a challenge and gets a random number. The command's tag must be the low 32 bits of
 *   SipHash-2-4, under a key of 128 bits that both know, over this number and the command. A challenge is good for one
 *   try and COMMAND_CHALLENGE_MS. Until then the same one is given to whoever asks. After a new challenge, and after a
 *   wrong tag, there is no other for COMMAND_PAUSE_MS.
 * STRENGTH  A recorded frame does nothing unless its challenge comes again, once in 2^32 challenges. Whoever has
 *   recorded k commands and keeps asking waits 136/k years. A random tag has one chance in 2^32 a try: all tags take
 *   136 years.
 * LIMITS  No secrecy. No protection of a key that is read out of the flash. No service while somebody floods the wire
 *   or sends wrong tags.
 *
 * SipHash: Aumasson & Bernstein, INDOCRYPT 2012, 489-508. */
#ifndef COMMAND_H
#define COMMAND_H

#include <stdbool.h>
#include <stdint.h>

#include "selfcal_frames.h"

/* The module's number on its bus, 0 to 11: `make ... NODE=3`. It moves the identifiers of all messages. */
#ifndef SELFCAL_NODE
#define SELFCAL_NODE 0
#endif
#if SELFCAL_NODE < 0 || SELFCAL_NODE > 11
#error "SELFCAL_NODE must be 0 to 11"
#endif

/* Identifier of this module's COMMAND message. */
#define COMMAND_ID (SELFCAL_FRAME_COMMAND_ID + SELFCAL_FRAME_NODE_IDS * SELFCAL_NODE)

#define COMMAND_CHALLENGE_MS 10000U
#define COMMAND_PAUSE_MS 1000U

typedef struct {
    bool open;   /* a challenge is */
    bool paused; /* ... and none other is given, since paused_ms */
    uint32_t challenge, opened_ms, paused_ms;
} command_t;

/* SipHash-2-4 of 8 bytes, given as one little-endian number. */
uint64_t command_siphash(const uint64_t key[2], uint64_t message);

/* Opens a challenge, the random `number`, unless one is open. True: `challenge` of the structure may be answered.
 * False: not so soon after another challenge or a wrong tag. */
bool command_open(command_t *self, uint32_t number, uint32_t now_ms);

/* Ends what is over. Call it more often than the time comes round. */
void command_pass(command_t *self, uint32_t now_ms);

/* Checks the tag of a command and uses up the challenge.
 * Returns SELFCAL_ANSWER_RESULT_DONE, _NO_CHALLENGE or _WRONG_TAG. */
uint8_t command_check(command_t *self, const uint64_t key[2], const uint8_t data[8], uint32_t now_ms);

#endif
