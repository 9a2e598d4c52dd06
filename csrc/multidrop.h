/* The functions of the C core that Python calls: frames, drives and ports. Those of rows are in rows.h, those
 * of captures in capture.h; functions that only C calls are in internal.h, line.h and engine.h.
 *
 * The headings of sections say what functions return, unless a function's own comment does. Times are in ns;
 * points in time are by CLOCK_MONOTONIC. Functions are pure (no I/O, callbacks or globals), except those of
 * ports, engine, row queue and clock. */
#ifndef MULTIDROP_H
#define MULTIDROP_H

#include <stddef.h>
#include <stdint.h>

/* cdef: start */
enum {
    MD_MOST_DATA = 250,       /* data bytes of a frame: 125 registers */
    MD_MOST_FRAME = 513,      /* longest frame: of Modbus ASCII, ':', 2 * 255 hex digits, CR, LF */
    MD_MOST_TCP = 260,        /* longest frame of Modbus TCP */
    MD_KEPT_FRAME = 24,       /* longest frame that an exchange stores; every read fits */
    MD_STATUSES = 23,         /* number of row statuses, not counting those from MD_EXCEPTION on */
    MD_EXCEPTION_CODES = 256,
    MD_DELAY_BUCKETS = 128,
    MD_MOST_OWED = 12,        /* limit of the outstanding requests of a drive */
    MD_MOST_PROOFS = 4,
    MD_PAUSE_S = 10,          /* s; after a longer silence another drive may have the address */
    MD_TIMES_KEPT = 6         /* send times stored for one outstanding request */
};

/* ---- frame.c: return the checksum ---- */

uint16_t md_crc16(const uint8_t *bytes, size_t len); /* CRC-16/MODBUS; sent low byte first */
uint8_t md_lrc(const uint8_t *bytes, size_t len);    /* of Modbus ASCII: two's complement of the sum */
uint8_t md_sum(const uint8_t *bytes, size_t len);    /* Delixi's checksum: the low byte of the sum */

/* ---- frame.c: return the frame's length (> 0), or an enum md_frame_fault (<= 0) ---- */

enum md_framing { MD_RTU, MD_ASCII, MD_DELIXI, MD_TCP };

/* The reasons why bytes are not a frame. */
enum md_frame_fault {
    MD_INCOMPLETE = 0,     /* more bytes are needed */
    MD_NO_START = -1,      /* not the start of a frame */
    MD_BAD_CHARACTER = -2, /* not an upper-case hex digit, or no CR LF at the end */
    MD_BAD_CHECKSUM = -3,
    MD_BAD_ADDRESS = -4,  /* the address of another drive */
    MD_BAD_FUNCTION = -5, /* neither the request's function nor its exception */
    MD_BAD_LENGTH = -6,   /* byte count or quantity does not match the request */
    MD_BAD_ECHO = -7,     /* the reply to a write repeats another address or value */
    MD_BAD_REQUEST = -8   /* a field of the request is out of bounds */
};

/* The content of a frame in any framing. The function determines the fields in use:
 *   01-04     request start, count         reply data
 *   05, 06    request and reply start, data (2 bytes)
 *   08        request and reply start (the subfunction), data (2 bytes)
 *   0F, 10    request start, count, data   reply start, count
 *   16        request and reply start, data (4 bytes)
 *   18        request start                reply data, from its byte count on
 *   Delixi    function is K, start is P1P0, data is D3..D0 (4 bytes); a reply to K = 03 carries
 *             its value in P1P0, and the parser copies it to data
 * `exception` is 0, or the code of an exception reply (Delixi: K = F0, FC..FF). `transaction` is the id in a
 * Modbus TCP frame, whose address may be any unit id. */
struct md_message {
    uint8_t address, function, exception;
    uint16_t transaction;
    uint16_t start, count;
    uint16_t data_len;
    uint8_t data[MD_MOST_DATA];
};

/* Write the frame to `out`, a buffer of `room` bytes. */
int md_build_request(int framing, const struct md_message *message, uint8_t *out, size_t room);
int md_build_reply(int framing, const struct md_message *message, uint8_t *out, size_t room);
/* Parse the request, to any address, at the start of `bytes`. */
int md_parse_request(int framing, const uint8_t *bytes, size_t len, struct md_message *message);
/* Parse the reply to `request` at the start of `bytes`; the transaction ids may differ. */
int md_parse_reply(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                   struct md_message *reply);
/* Return the length of a good reply to `request`; 0 if the request is a broadcast. */
int md_reply_length(int framing, const struct md_message *request);

/* ---- serial.c: return 0, -errno, or a mask of enum md_refusal ---- */

struct md_settings {
    uint32_t baudrate;
    uint8_t databits; /* 7, 8 */
    char parity;      /* 'N', 'E', 'O' */
    uint8_t stopbits; /* 1, 2 */
};

enum md_refusal {
    MD_REFUSED_BAUDRATE = 1,
    MD_REFUSED_DATABITS = 2,
    MD_REFUSED_PARITY = 4,
    MD_REFUSED_STOPBITS = 8,
    MD_REFUSED_DIVISOR = 16 /* no whole divisor of the UART's clock yields the baud rate */
};

/* Put the port into raw mode with these settings and read them back. Return the mask of settings that the
 * port did not take. */
int md_port_set(int fd, const struct md_settings *settings);
int md_port_get(int fd, struct md_settings *settings);
/* Return the baud rate of divisor 1, from which the UART derives all others; 0: unknown. */
uint32_t md_port_baud_base(int fd);

/* Close the port behind `fd`, which then refers to the file of `other`. The driver has `most_ns` to send its
 * remaining bytes; then it discards them. */
int md_port_close(int fd, int other, int64_t most_ns);

/* ---- clock.c: return a time ---- */

int64_t md_now_ns(void);
/* Return UTC - CLOCK_MONOTONIC. The value changes only if it is wrong by more than 0.1 ms, so that a moment
 * has one UTC time in all recordings. */
int64_t md_utc_minus_monotonic_ns(void);

/* ---- stats.c, late.c: a drive's statistics; times are in ns ---- */

/* Counters of a drive's exchanges; all except longest_ns only grow. `values`: number of values read. */
struct md_counters {
    uint64_t exchanges, answered, values;
    uint64_t sent;        /* requests that were sent, at least in part */
    uint64_t stray_bytes; /* bytes outside of replies */
    uint64_t ideal_ns;    /* sum of the shortest possible line times of the answered exchanges */
    int64_t longest_ns;   /* longest response delay */
};

/* An outstanding request: its replies may still come. */
struct md_owed {
    int64_t sent_ns[MD_TIMES_KEPT]; /* send times, earliest first; the last one is the latest */
    uint32_t times;
    uint32_t end;   /* `least` and `end`: range of the reply, as in md_exchange */
    uint16_t least;
    uint16_t start, count, reply_len;
    uint8_t framing, address, function, data_len;
    uint8_t data[4];
    uint8_t is_doubtful; /* 1: a reply came that may be to this request, or to one of another process */
};

/* An outstanding request of Modbus TCP. */
struct md_unanswered {
    int64_t sent_ns;
    uint16_t transaction;
    uint8_t address;
};

/* More counts of a drive, and its outstanding requests. */
struct md_history {
    uint64_t ended[MD_STATUSES];       /* exchanges without a reply, by status; MD_OK: broadcasts */
    uint64_t missed[MD_STATUSES];      /* missing values, by status */
    uint64_t late;                     /* replies that came after their request's timeout */
    uint64_t exceptions, naks, busies; /* all exceptions; those with code 7; those with code 6 */
    uint32_t refused[MD_EXCEPTION_CODES]; /* missing values, by exception code */
    uint64_t pauses;                      /* replies that came MD_PAUSE_S or more after the previous one */
    struct md_owed owed[MD_MOST_OWED];
    struct md_unanswered unanswered[MD_MOST_OWED]; /* the oldest request first */
};

/* A drive. The caller sets interval_ns and the bounds of the timeout; the core learns the other fields, which
 * start as 0. A timeout runs from the request's last bit to the reply's first. Starting an exchange accesses
 * only the first cache line of this struct; ending it also accesses the second. */
struct md_drive {
    int64_t least_timeout_ns, most_timeout_ns;
    int64_t delay_ns, deviation_ns;    /* smoothed response delay, and its mean deviation */
    int64_t patience_ns;               /* a longer timeout, learnt from late replies; 0: none */
    int64_t interval_ns;               /* least time between an exchange and the next request */
    int64_t ready_ns;                  /* earliest time of the next request */
    uint32_t failures;                 /* number of consecutive exchanges without a reply */
    uint8_t owed_count, proof_count;
    uint8_t is_doubted;                /* 1: the drive's first reply may answer another process's request */
    uint8_t sure_looks;                /* how many of the next replies are read only when complete */
    struct md_counters counters;
    int64_t answered_ns;               /* requests sent before this time get no further reply */
    int64_t late_until_ns;             /* late replies may come in any order until then */
    uint64_t failed_at;                /* the drive's count of replies when a proof last failed */
    uint8_t proof_failures[MD_MOST_PROOFS]; /* number of failures of each proof; 255: it was answered once */
    uint32_t doubtful;                 /* number of replies that may have been to another process's request */
    uint32_t unanswered_count;
    const struct md_exchange **proofs; /* reads whose replies cannot be mistaken for late replies */
    struct md_drive *next_late;        /* next in the line's list of drives with late replies due */
    struct md_history *history;        /* separate because exchanges seldom need it */
    uint64_t delays[MD_DELAY_BUCKETS]; /* replies by delay; bucket n starts at md_delay_edge(n) */
};

int64_t md_present_timeout_ns(const struct md_drive *drive); /* usual timeout of a read */
int64_t md_next_timeout_ns(const struct md_drive *drive); /* timeout of the next read; see stats.c */
int64_t md_delay_edge(int bucket); /* least delay of a bucket; the bucket's width is 1/8 of that delay */
/* Copy the outstanding requests of `before` to `drive`, which replaces `before`. */
void md_late_inherit(struct md_drive *drive, const struct md_drive *before);

/* ---- engine.c, api.c: functions that return a pointer return NULL and set errno on failure ---- */

enum md_echo { MD_ECHO_UNKNOWN, MD_ECHO, MD_NO_ECHO };

/* How a port uses transaction ids. */
enum md_transactions {
    MD_NO_TRANSACTIONS, /* every framing except MD_TCP */
    MD_MATCHED,         /* MD_TCP: a reply has the id of its request */
    MD_IGNORED          /* MD_TCP through a gateway that replies with its own transaction ids */
};

/* Who switches the transceiver between sending and receiving. */
enum md_rs485_mode {
    MD_RS485_OFF,     /* the adapter itself */
    MD_RS485_KERNEL,  /* the kernel's driver, as it is configured */
    MD_RS485_RTS_UP,  /* RTS: on while this port sends, otherwise off */
    MD_RS485_RTS_DOWN /* RTS: off while this port sends, otherwise on */
};

/* A request with its drive, timing and settings; constant while in use. Fields that every exchange needs come
 * first, in two cache lines. With many serial lines, the processor must read these fields from memory. */
struct md_exchange {
    struct md_drive *drive;
    struct md_block *block;        /* fields for rows; NULL: no rows */
    const struct md_block *values; /* fields whose values md_port_carry_out() returns; NULL: none */
    int64_t character_ns;          /* duration of a character on the wire */
    int64_t silence_ns;            /* silence kept before the request and after its reply */
    /* Lower bound of a write's timeout; 0: use the learnt timeout. With `insists`: instead, how long a stop
     * may wait for a late reply; 0 also shows that it is a drive's first stop. */
    int64_t timeout_ns;
    int64_t period_ns; /* time between the exchange's slots in the queue; 0: no fixed period */
    /* An exchange to send first while it is unknown whether the adapter echoes. Its reply is never a copy of
     * its request. NULL: none. */
    const struct md_exchange *echo_probe;
    struct md_settings settings;
    int framing;
    uint16_t insists;      /* 1: a stop, sent even if a late reply may be mistaken for its reply */
    uint16_t is_stop_read; /* 1: a read of a stop; it may precede stops of silent drives */
    uint32_t end;         /* upper bound (exclusive) of the reply's only register; 0: no range */
    uint16_t least;       /* lower bound (inclusive) of the reply's only register */
    uint8_t is_proof;     /* 1: the exchange is in its drive's list of proofs */
    uint8_t frame_len;    /* 0: the frame is not stored, but built at each turn */
    uint8_t frame[MD_KEPT_FRAME];
    struct md_message request;
    int64_t turnaround_ns; /* silence after a broadcast */
    const uint32_t *stops; /* the drive's stop counter: send only while it equals stops_seen; NULL: always */
    uint32_t stops_seen;
};

/* The reasons why an exchange has no reply. If bytes came that are not a reply, see enum md_frame_fault. */
enum md_failure {
    MD_CUT_SHORT = -9,         /* the reply was incomplete at the timeout */
    MD_NO_REPLY = -10,         /* no byte within the timeout except the request's echo */
    MD_LINE_LOST = -11,        /* the port failed; `error`: errno, 0 at end of file, EPROTO: no Modbus TCP */
    MD_SETTINGS_REFUSED = -12, /* the port did not take baud rate or format */
    MD_LATE_ANSWER_DUE = -13,  /* not sent, or its reply rejected: the reply may be to an earlier request */
    MD_EXPIRED = -14,          /* not sent: its latest time had passed, or a stop came first */
    MD_POLL_ENDED = -16,       /* polling ended before this exchange's turn or reply */
    MD_MAYBE_ECHO = -17,       /* the bytes may be the reply or the adapter's echo */
    MD_NOT_MASTER = -19,       /* this process lost the right to send; part of the request may have left */
    MD_OTHER_MASTER = -20,     /* not sent: another master uses the line */
    MD_POLLING_FAILED = -21,   /* not sent: the client that queues requests failed */
    MD_STALLED = -22           /* not sent: the adapter has not taken the bytes of earlier requests */
};

/* The result of an exchange. first_ns and last_ns are 0 if no byte came. */
struct md_completion {
    int result;                /* > 0: length of the reply; 0: a broadcast was sent; < 0: enum md_failure */
    int error;                 /* MD_LINE_LOST: errno; MD_SETTINGS_REFUSED: enum md_refusal */
    int64_t begun_ns; /* start of the exchange's turn, which includes the silence before its request */
    int64_t sent_ns;           /* when the first byte of the request left; 0: never */
    int64_t utc_ahead_ns;      /* UTC - CLOCK_MONOTONIC at sent_ns; 0: unknown */
    int64_t first_ns, last_ns; /* arrival of the first and the last byte after the request */
    int64_t late_until_ns;     /* urgent exchange: the drive's late_until_ns when the client called */
    uint32_t stale;            /* bytes discarded before the request: late replies, noise */
    uint32_t skipped;          /* bytes after the request that are not part of the reply */
    uint16_t raw_len;
    struct md_message reply;   /* a good reply or an exception */
    uint8_t raw[MD_MOST_FRAME]; /* the reply; after a failure the last bytes received */
};

/* Progress of a port. Its counters only grow, and wrap around. */
struct md_progress {
    uint32_t submitted, done;
    uint32_t lost;        /* the descriptor failed: all later urgent exchanges end as MD_LINE_LOST */
    uint32_t cut_off;     /* the loss interrupted a polled exchange, on a port that had worked before */
    uint32_t repeating;   /* 1: the port repeats exchanges */
    uint32_t switches;    /* number of changes of baud rate or format */
    uint32_t echo;        /* enum md_echo: whether the adapter echoes */
    uint32_t foreign;     /* another master's bytes, received while listening */
    uint32_t stalled;     /* 1: at the last timeout the driver still held the request */
    uint32_t miscounts;   /* 1: the driver's count of unsent bytes is wrong, and is ignored */
    uint32_t called_off;  /* 1: the driver may still hold bytes of a command that has ended */
    int32_t lost_error;   /* errno of the loss; 0: the far end hung up */
    int64_t switching_ns; /* total duration of all changes of baud rate or format, in ns */
};

struct md_engine;
struct md_port;
struct md_row_queue; /* rows.h */
struct md_tap;
struct md_mastership;

struct md_engine *md_engine_start(void); /* start the thread of all lines, which ends with the process */
/* Start or end realtime scheduling of the thread; return 0 or -errno. If the thread uses too much of a
 * processor, it returns to normal scheduling by itself. One client at a time may call this. */
int md_engine_realtime(struct md_engine *engine, int wanted);
int md_engine_is_realtime(struct md_engine *engine); /* 1: under realtime scheduling now */
/* Sleep `n` times for `period_ns` on the calling thread, in the way in which the engine's thread sleeps.
 * Write to `late_ns` how late each sleep ended; return 0 or -errno. */
int md_wake_lateness(int is_realtime, int64_t period_ns, int64_t *late_ns, int n);

/* Open a port on a descriptor. `must_take`: mask of the settings whose refusal is a failure (enum
 * md_refusal); -1: the port has no settings. `transactions`: enum md_transactions. `room`: the queue's length
 * in exchanges, a power of two. */
struct md_port *md_port_open(struct md_engine *engine, int fd, int must_take, int transactions,
                             unsigned room);
/* Send only while this process is master, which is checked right before each write(2). The mastership must
 * outlive the port. Before the first request, and after any gap in the mastership, the port listens to the
 * line. It listens at least for the mastership's guard time. Stops do not wait for the end of listening. */
void md_port_fence(struct md_port *port, struct md_mastership *mastership);
/* Set who switches the transceiver (enum md_rs485_mode), before the first request; return 0 or -errno. A USB
 * adapter cannot report when the last bit of a request has left. */
int md_port_rs485(struct md_port *port, int mode, int is_usb);
/* Copy all bytes of the line to `tap`, which must outlive the port or be replaced first. */
void md_port_tap(struct md_port *port, struct md_tap *tap);
/* Start only urgent exchanges from now on, no queued or repeated ones. Return 1 while a queued or repeated
 * exchange is in flight. */
int md_port_end(struct md_port *port);
/* Return 1 while an exchange with this drive is queued, repeated, urgent or in flight. */
int md_port_is_asking(struct md_port *port, const struct md_drive *drive);
/* Return the time up to which all line use has been counted. If an exchange is in flight, that is its
 * start. */
int64_t md_port_counted_ns(struct md_port *port);
/* Call md_late_inherit() under the engine's lock. */
void md_port_inherit(struct md_port *port, struct md_drive *drive, const struct md_drive *before);
/* Stop all exchanges and give the descriptor back. After md_port_end() a queued or repeated exchange in
 * flight ends as MD_POLL_ENDED. */
void md_port_stop(struct md_port *port);
/* Stop and free the port. `memory` is unused; the argument keeps the client's memory alive during the
 * call. */
void md_port_free(struct md_port *port, void *memory);
/* Set whether the adapter echoes: MD_ECHO is final, MD_NO_ECHO holds until an echo comes. */
void md_port_set_echo(struct md_port *port, int echo);
/* Deliver rows to `row_queue`, and wake its client with `number` when the port needs attention. */
void md_port_report(struct md_port *port, struct md_row_queue *row_queue, uint32_t number);
/* Queue exchanges, each with its earliest time; return how many fitted. Only one client at a time may call
 * this. A slot ends as MD_EXPIRED if it is a period late and the next slot of the same exchange is due. */
int md_port_submit(struct md_port *port, const struct md_exchange *const *exchanges,
                   const int64_t *not_before_ns, int n);
/* Repeat these exchanges in turn whenever no queued exchange is due. Repetition ends when the next call
 * replaces them, the port is lost, or an exchange could not be sent. Return the index of the replaced
 * exchange that would have been sent next. */
unsigned md_port_repeat(struct md_port *port, const struct md_exchange *const *exchanges, unsigned n);
const struct md_progress *md_port_progress(struct md_port *port);
/* Count a stop: from now on, urgent exchanges that were created with an older count are not sent. */
void md_count_stop(uint32_t *stops);
/* Carry out an urgent exchange ahead of the queue and wait for it; an exchange with `insists` precedes all
 * others. After `expires_ns` (of CLOCK_BOOTTIME; 0: never), or after a stop, it is not sent (MD_EXPIRED). If
 * urgent exchanges never pause, the queue still gets a 20th of the line's time, except while an exchange with
 * `insists` waits. Write the exchange's values, NaN for a missing one, and return how many exist; -1 without
 * a good reply, or after an exception. */
int md_port_carry_out(struct md_port *port, const struct md_exchange *exchange, int64_t not_before_ns,
                      int64_t expires_ns, struct md_completion *completion, double *values);

/* ---- mastership.c, api.c: on failure, set errno and return NULL (md_mastership_new) or -1 (_extend) ---- */

int64_t md_boottime_ns(void); /* the time of CLOCK_BOOTTIME, which all times of this section use */
/* Return a mastership that has not started yet; ENOSYS if the kernel lacks the timer. Ports listen to their
 * line for at least `guard_ns` before they send. */
struct md_mastership *md_mastership_new(int64_t guard_ns);
void md_mastership_free(struct md_mastership *mastership); /* call it after all ports that use it are freed */
/* Make this process master until `until_ns`. The kernel kills the process at `kill_ns` unless the mastership
 * is extended or ended before. */
int md_mastership_extend(struct md_mastership *mastership, int64_t until_ns, int64_t kill_ns);
/* End the mastership: when this call returns, no further byte leaves, and the kernel's timer is disarmed. */
void md_mastership_end(struct md_mastership *mastership);
int64_t md_mastership_until_ns(const struct md_mastership *mastership); /* 0: this process is not master */
int md_mastership_holds(const struct md_mastership *mastership);
/* cdef: end */

#endif
