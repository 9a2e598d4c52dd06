/* The functions that only C calls, except those of a line and its turns (line.h). Python tests can also call
 * the functions between the `cdef` marks. */
#ifndef MULTIDROP_INTERNAL_H
#define MULTIDROP_INTERNAL_H

#include "capture.h"

#include <pthread.h>
#include <stdatomic.h>
#include <time.h>

/* cdef: start */
/* ---- stats.c: counters ---- */

/* Count an exchange that ended. */
void md_counters_end(const struct md_exchange *exchange, const struct md_completion *completion);
/* Count a reply with its delay and the least time that its exchange needs on the line. */
void md_counters_answer(struct md_drive *drive, int64_t delay_ns, int64_t ideal_ns);
uint64_t md_replies(const struct md_drive *drive);
/* the histogram's counter of the drive's usual delay */
const uint64_t *md_usual_delays(const struct md_drive *drive);

/* ---- clock.c ---- */

/* Return the same as md_utc_minus_monotonic_ns(); `now_ns` was just read from CLOCK_MONOTONIC. */
int64_t md_utc_ahead_ns(int64_t now_ns);

/* ---- columns.c, row_queue.c ---- */

/* Append one row for each of the block's fields; return the number of rows, 0 if there is no room. */
int md_columns_add(struct md_columns *columns, const struct md_block *block,
                   const struct md_completion *completion, int64_t utc_minus_monotonic_ns);
/* Return the number of the block's fields that have no value in a good reply. */
uint64_t md_count_lacking(const struct md_block *block, const struct md_message *reply);
/* Keep the queue in memory until one more call of md_row_queue_release(). */
void md_row_queue_hold(struct md_row_queue *row_queue);
/* Append the exchange's rows to the newest chunk; do nothing if `block` is NULL. */
void md_row_queue_add(struct md_row_queue *row_queue, const struct md_block *block,
                      const struct md_completion *completion);
/* cdef: end */

/* ---- body.c: the content of frames, from the address on ---- */

enum { MD_MOST_BODY = 253 }; /* body of a reply with 125 registers; the standard allows 254 bytes */

/* Return the length of a body: of a request if `request` is NULL, otherwise of the reply to `request`. Return
 * MD_INCOMPLETE while the first bytes do not determine the length. */
int md_body_length(int framing, const uint8_t *body, size_t have, const struct md_message *request);
/* Return the body length of a good reply to `request`; 0 if the request is a broadcast. */
int md_body_reply_length(int framing, const struct md_message *request);
/* Return the body length of the longest possible reply, for requests that do not determine their reply's
 * length. */
int md_body_longest_reply(int framing, const struct md_message *request);
/* Write the fields after address and function; return the body's length, MD_BAD_REQUEST if a field is out of
 * bounds. */
int md_body_put_request(int framing, const struct md_message *message, uint8_t *body);
int md_body_put_reply(int framing, const struct md_message *message, uint8_t *body);
void md_body_get_request(int framing, const uint8_t *body, struct md_message *message);
/* Read a whole reply into `message`; return 0 if the reply does not confirm its request. */
int md_body_get_reply(int framing, const uint8_t *body, const struct md_message *request,
                      struct md_message *reply);

/* ---- frame.c ---- */

enum {
    MD_MOST_ADDRESS = 247,
    MD_TCP_HEAD = 6, /* bytes of the MBAP header before the unit id, which is the address */
    MD_TCP_EXCEPTION = MD_TCP_HEAD + 3
};

enum {
    MD_WRITE_COIL = 0x05,
    MD_WRITE_ONE = 0x06,
    MD_READ_STATUS = 0x07, /* read exception status (V1.1b3, 6.7) */
    MD_LOOPBACK = 0x08,
    MD_REPORT_ID = 0x11,     /* report server id (6.13) */
    MD_MASK_WRITE = 0x16,
    MD_READ_IDENTITY = 0x2B, /* read device identification (6.21) */
    MD_EXCEPTION_BIT = 0x80
};

/* Delixi's function code K (Delixi's manual, part 3): a master sends K = 2 to 7. */
enum { MD_DELIXI_RUN = 2, MD_DELIXI_STATE_QUERY = 3, MD_DELIXI_PARAMETER_QUERY = 7 };

/* Numbers in frames are big-endian. */
static inline uint16_t md_get16(const uint8_t *at)
{
    return (uint16_t)(at[0] << 8 | at[1]);
}

static inline uint8_t *md_put16(uint8_t *at, unsigned value)
{
    at[0] = (uint8_t)(value >> 8);
    at[1] = (uint8_t)value;
    return at + 2;
}

/* Copy only the used part of the data: most messages are short. */
void md_copy_message(struct md_message *to, const struct md_message *from);
int md_hex_byte(const uint8_t digits[2]); /* value of two upper-case hex digits; -1: not such digits */
/* Return the length in a Modbus TCP header, or an enum md_frame_fault. */
int md_tcp_length(const uint8_t *bytes, size_t len);
/* Return 1 if the bytes start an exception to this request. An exception's length is fixed, although some
 * devices put another length into the header. */
int md_tcp_is_exception(const uint8_t *bytes, size_t len, const struct md_message *request);
/* Return 1 if the reply is a gateway's exception, which reports that the drive is unreachable or silent. */
int md_is_from_gateway(int framing, const struct md_message *reply);
/* Return the length of the longest possible reply's frame, for requests that do not determine their reply's
 * length; 0 for a broadcast. */
int md_longest_reply(int framing, const struct md_message *request);
/* Return the reason why these bytes are not the reply: enum md_frame_fault, MD_CUT_SHORT or MD_NO_REPLY. */
int md_reason(int framing, const struct md_message *request, const uint8_t *bytes, size_t len);

/* ---- stats.c: delays and timeouts ---- */

/* Return how long after the end of a request to read the port, not counting the reply's time on the wire. */
int64_t md_look_ns(const struct md_exchange *exchange);
int64_t md_timeout_ns(const struct md_exchange *exchange);
/* Return the time, with a margin, within which a reply starts after its request; 0 if the drive's delays vary
 * too much or are not known well enough. */
int64_t md_reply_due_ns(const struct md_exchange *exchange);
/* Learn from a reply's delay, and return the best estimate of the delay. With `is_whole`, the first read
 * found the whole reply, so `delay_ns` is only an upper bound. */
int64_t md_learn_delay(const struct md_exchange *exchange, int64_t delay_ns, int is_whole);
/* Use a longer timeout, because a late reply came `delay_ns` after its request. If the request was sent
 * several times, `delay_ns` counts from the last time and `is_exact` is 0. */
void md_learn_lateness(struct md_drive *drive, int64_t delay_ns, int is_exact);
/* After a timeout, halve the longer timeout that md_learn_lateness() set. */
void md_learn_silence(struct md_drive *drive);
/* Return the time after an exchange's timeout in which late replies may come in any order. */
int64_t md_window_ns(const struct md_exchange *exchange);

/* Set the drive's count of failures, which clients read at any time. */
static inline void md_count_failures(struct md_drive *drive, uint32_t failures)
{
    if (drive->failures != failures)
        __atomic_store_n(&drive->failures, failures, __ATOMIC_RELAXED);
}

/* ---- tap.c, capture.c ---- */

/* The enhanced packet block of a pcapng file (draft-ietf-opsawg-pcapng, 4.3). */
enum {
    MD_PACKET_BLOCK = 6,
    MD_PACKET_HEAD = 28, /* bytes before a packet's content */
    MD_PACKET_END = 4    /* bytes after a packet's content */
};

void md_tap_put(struct md_tap *tap, int side, int64_t time_ns, const uint8_t *bytes, size_t len);

/* ---- waiter.c: wait for many descriptors ---- */

struct md_waiter;

struct md_waiter *md_waiter_new(void); /* NULL: see errno */
void md_waiter_free(struct md_waiter *waiter);
/* Report `owner` whenever the descriptor is readable; -1: see errno. */
int md_waiter_add(struct md_waiter *waiter, int fd, void *owner);
/* Set whether the waiter reports this descriptor. */
void md_waiter_change(struct md_waiter *waiter, int fd, void *owner, int watched);
void md_waiter_remove(struct md_waiter *waiter, int fd);
/* Wait at most `timeout_ns`, forever if that is negative; write the owners of readable descriptors and return
 * their number. */
int md_waiter_wait(struct md_waiter *waiter, void **ready, int room, int64_t timeout_ns);

/* ---- serial.c ---- */

int md_port_keep_rts(int fd); /* leave RTS unchanged when the port is closed; return 0 or -errno */

/* ---- waiter.c: wake the waiting thread ---- */

struct md_wakeup {
    int fd, ringer; /* `fd` is readable from md_wakeup_ring() until md_wakeup_silence() */
    atomic_int is_rung;
};

int md_wakeup_make(struct md_wakeup *wakeup); /* -1: see errno */
void md_wakeup_destroy(struct md_wakeup *wakeup);
void md_wakeup_ring(struct md_wakeup *wakeup);
void md_wakeup_silence(struct md_wakeup *wakeup);

/* ---- realtime.c: on the thread itself ---- */

struct md_realtime {
    atomic_int is_on;
    int64_t checked_ns, used_ns; /* time of the last check, and the thread's CPU time then */
#ifdef __linux__
    timer_t timer;
#elif defined _WIN32
    void *task;
#endif
};

int md_realtime_start(struct md_realtime *realtime); /* 0, -errno */
void md_realtime_end(struct md_realtime *realtime);
/* End realtime scheduling if the thread used more than half of a processor. Call this at least twice in each
 * second of the thread's CPU time. */
void md_realtime_check(struct md_realtime *realtime, int64_t now_ns);

/* ---- mutexes ---- */

/* Initialise a mutex between the engine's thread and clients. If the system can, a client that holds it
 * inherits the priority of a realtime thread that waits for it. */
static inline void md_mutex_init(pthread_mutex_t *mutex)
{
#ifdef __linux__
    pthread_mutexattr_t inherits;
    pthread_mutexattr_init(&inherits);
    pthread_mutexattr_setprotocol(&inherits, PTHREAD_PRIO_INHERIT);
    int failure = pthread_mutex_init(mutex, &inherits);
    pthread_mutexattr_destroy(&inherits);
    if (!failure)
        return;
#endif
    pthread_mutex_init(mutex, NULL);
}

/* ---- times ---- */

#define MD_NEVER INT64_MAX
#define MD_SECOND_NS INT64_C(1000000000)

static inline int64_t md_clock_ns(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * MD_SECOND_NS + now.tv_nsec;
}

/* The fields of a timespec are 32 bits wide on some systems. */
static inline struct timespec timespec_of(int64_t ns)
{
    return (struct timespec){.tv_sec = (time_t)(ns / MD_SECOND_NS), .tv_nsec = (long)(ns % MD_SECOND_NS)};
}

static inline int64_t later(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

static inline int64_t sooner(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

#endif
