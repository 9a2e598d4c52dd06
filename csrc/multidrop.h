/* The functions of the C core that Python calls: frames, drives, ports and rows. Those of captures are in
 * capture.h, and those that only C calls in internal.h, line.h and engine.h.
 *
 * Each section begins with its one return rule. Times are in ns, of CLOCK_MONOTONIC where they are moments.
 * All but port, engine, row queue and clock are pure: no I/O, no callbacks, no globals. */
#ifndef MULTIDROP_H
#define MULTIDROP_H

#include <stddef.h>
#include <stdint.h>

/* cdef: begin */
enum {
    MD_MOST_DATA = 250,       /* data bytes of a frame: 125 registers */
    MD_MOST_FRAME = 513,      /* ':', 2 * 255 hex digits, CR, LF */
    MD_MOST_TCP = 260,        /* a frame of Modbus TCP */
    MD_KEPT_FRAME = 24,       /* the longest frame that its exchange keeps: that of any read */
    MD_STATUSES = 22,         /* of a row without an exception */
    MD_EXCEPTION_CODES = 256,
    MD_DELAY_BUCKETS = 128,
    MD_MOST_OWED = 12,        /* requests of a drive whose replies may still come */
    MD_MOST_PROOFS = 4,
    MD_PAUSE_S = 10,          /* without a reply, in which another drive may take the place of one */
    MD_TIMES_KEPT = 6         /* when the same request was sent */
};

/* ---- frame.c: return the checksum ---- */

uint16_t md_crc16(const uint8_t *bytes, size_t len); /* CRC-16/MODBUS; the low byte goes first */
uint8_t md_lrc(const uint8_t *bytes, size_t len);    /* two's complement of the sum */
uint8_t md_sum(const uint8_t *bytes, size_t len);    /* Delixi's own: the sum's low byte */

/* ---- frame.c: return the frame's length (> 0), or an enum md_frame_fault (<= 0) ---- */

enum md_framing { MD_RTU, MD_ASCII, MD_DELIXI, MD_TCP };

/* The reason why bytes are no frame. */
enum md_frame_fault {
    MD_INCOMPLETE = 0,     /* more bytes are needed */
    MD_NO_START = -1,      /* no frame begins here */
    MD_BAD_CHARACTER = -2, /* no upper-case hex digit, or no CR LF at the end */
    MD_BAD_CHECKSUM = -3,
    MD_BAD_ADDRESS = -4,  /* another drive's */
    MD_BAD_FUNCTION = -5, /* neither the request's function nor its exception */
    MD_BAD_LENGTH = -6,   /* byte count or quantity differs from the request's */
    MD_BAD_ECHO = -7,     /* a write confirmed with another address or value */
    MD_BAD_REQUEST = -8   /* no frame can say this: a field is out of bounds */
};

/* One frame's meaning, whatever its framing. Which fields count depends on the function:
 *   01-04     request start, count         reply data
 *   05, 06    request and reply start, data (2 bytes)
 *   08        request and reply start (the subfunction), data (2 bytes)
 *   0F, 10    request start, count, data   reply start, count
 *   Delixi's  function is K, start is P1P0, data is D3..D0 (4 bytes); a reply to K = 03 carries
 *             its value in P1P0, and has it in data too
 * `exception` is 0, or the code of an exception reply; of Delixi's protocol K = F0, FC..FF. `transaction` is
 * the id in a frame of Modbus TCP, whose address is any unit id. */
struct md_message {
    uint8_t address, function, exception;
    uint16_t transaction;
    uint16_t start, count;
    uint16_t data_len;
    uint8_t data[MD_MOST_DATA];
};

/* Write the frame to `out`, which has room for `room` bytes. */
int md_build_request(int framing, const struct md_message *message, uint8_t *out, size_t room);
int md_build_reply(int framing, const struct md_message *message, uint8_t *out, size_t room);
/* Parse a request to any address at the beginning of `bytes`. */
int md_parse_request(int framing, const uint8_t *bytes, size_t len, struct md_message *message);
/* Parse the reply to `request`, whatever its transaction, at the beginning of `bytes`. */
int md_parse_reply(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                   struct md_message *reply);
/* Return the length of the good reply to `request`; 0 after a broadcast. */
int md_reply_length(int framing, const struct md_message *request);

/* ---- termios.c: return 0, -errno, or a mask of enum md_refusal ---- */

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
    MD_REFUSED_STOPBITS = 8
};

/* Make the port raw with these settings, and read them back to find what it did not take. */
int md_port_set(int fd, const struct md_settings *settings);
int md_port_get(int fd, struct md_settings *settings);

/* ---- clock.c: return a time ---- */

int64_t md_now_ns(void);
/* Return UTC - CLOCK_MONOTONIC. The value is kept while it is right to 0.1 ms, so that a moment has the same
 * UTC in every recording. */
int64_t md_utc_minus_monotonic_ns(void);

/* ---- stats.c, late.c: what is known of a drive; return a time in ns ---- */

/* Counts of a drive's exchanges; all but longest_ns only grow. Values are those of the exchange's block. */
struct md_counters {
    uint64_t exchanges, answered, values;
    uint64_t sent;        /* requests that began to leave */
    uint64_t stray_bytes; /* bytes that were no part of a reply */
    uint64_t ideal_ns;    /* the least time on the line that the answered exchanges needed */
    int64_t longest_ns;   /* response delay */
};

/* A request whose replies may still come. */
struct md_owed {
    int64_t sent_ns[MD_TIMES_KEPT]; /* earliest first; later ones without room count as the last */
    uint32_t times;
    uint32_t end;   /* of the reply, as in md_exchange */
    uint16_t least; /* likewise */
    uint16_t start, count, reply_len;
    uint8_t framing, address, function, data_len;
    uint8_t data[4];
    uint8_t is_doubtful; /* a reply came that may answer another process's request */
};

/* A request of Modbus TCP whose reply may still come. */
struct md_unanswered {
    int64_t sent_ns;
    uint16_t transaction;
    uint8_t address;
};

/* More counts of a drive, and its requests whose replies may still come. */
struct md_history {
    uint64_t ended[MD_STATUSES];       /* exchanges without a reply, by status; MD_OK: broadcasts */
    uint64_t missed[MD_STATUSES];      /* values, by status */
    uint64_t late;                     /* replies that came after their time-out */
    uint64_t exceptions, naks, busies; /* exchanges that ended with an exception; with code 7; with code 6 */
    uint32_t refused[MD_EXCEPTION_CODES]; /* values, by exception code */
    uint64_t pauses;                      /* replies that came MD_PAUSE_S or more after the one before */
    struct md_owed owed[MD_MOST_OWED];
    struct md_unanswered unanswered[MD_MOST_OWED]; /* the oldest first */
};

/* A drive: the bounds of its time-out and its interval are given, the rest is learnt from its exchanges and
 * begins as 0. A time-out runs from the request's last bit to the reply's first.
 * A request needs the first cache line, its end the second one too. */
struct md_drive {
    int64_t least_timeout_ns, most_timeout_ns;
    int64_t delay_ns, deviation_ns;    /* the response delay, smoothed, and its mean deviation */
    int64_t patience_ns;               /* a longer time-out, learnt from late replies */
    int64_t interval_ns;               /* from the end of an exchange to its next request, at least */
    int64_t ready_ns;                  /* no request leaves for it before then */
    uint32_t failures;                 /* in a row */
    uint8_t owed_count, proof_count;
    uint8_t is_doubted;                /* its first reply may answer what another process asked */
    uint8_t sure_looks;                /* so many replies are whole at the first look, if it stays steady */
    struct md_counters counters;
    int64_t answered_ns;               /* requests that left before then are answered, or never will be */
    int64_t late_until_ns;             /* until then a late reply may come, in any order */
    uint64_t vain_at;                  /* its replies, when a proof was given up */
    uint8_t vain[MD_MOST_PROOFS];      /* how often each proof was given up; 255: it was answered once */
    uint32_t doubtful;                 /* replies of which it was doubted that they were its own */
    uint32_t unanswered_count;
    const struct md_exchange **proofs; /* reads whose replies differ from others' */
    struct md_drive *next_late;        /* the next one on this line with late replies due */
    struct md_history *history;        /* apart, for it is seldom needed: an exchange touches fewer pages */
    uint64_t delays[MD_DELAY_BUCKETS]; /* replies by response delay: bucket n begins at md_delay_edge(n) */
};

int64_t md_present_timeout_ns(const struct md_drive *drive); /* of a read */
int64_t md_vain_ns(const struct md_drive *drive);            /* of the next read, if the drive stays silent */
int64_t md_delay_edge(int bucket); /* the least delay of a bucket, which is an eighth of that wide */
/* Hand over the late replies that are due of another drive, whose place this one takes. */
void md_late_inherit(struct md_drive *drive, const struct md_drive *before);

/* ---- engine.c, api.c: return NULL and set errno on failure; counts and flags else ---- */

enum md_echo { MD_ECHO_UNKNOWN, MD_ECHO, MD_NO_ECHO };

/* The framing of a port's exchanges. */
enum md_transactions {
    MD_NO_TRANSACTIONS, /* any but MD_TCP */
    MD_MATCHED,         /* MD_TCP: a reply has its request's id */
    MD_IGNORED          /* MD_TCP through a gateway that replies with ids of its own */
};

/* The transceiver's direction: who switches it. */
enum md_rs485_mode {
    MD_RS485_OFF,     /* the adapter itself */
    MD_RS485_KERNEL,  /* the driver, with polarity and delays as they are set up there */
    MD_RS485_RTS_UP,  /* this port: RTS is on while a request leaves */
    MD_RS485_RTS_DOWN /* this port: RTS is off then, and on else */
};

/* One request with all that is needed to carry it out; constant while in use. What every exchange needs comes
 * first, in two cache lines: with many lines each of them is read from memory. */
struct md_exchange {
    struct md_drive *drive;
    struct md_block *block;        /* fields of its reply; NULL: no rows */
    const struct md_block *values; /* what the caller of md_port_carry_out() gets; NULL: nothing */
    int64_t character_ns;          /* one character on the wire */
    int64_t silence_ns;            /* before the request and after its reply */
    /* The least time-out, of a write; 0: as learnt. One that insists waits as long as late replies are
     * known to take, but not beyond this. */
    int64_t timeout_ns;
    int64_t period_ns; /* between its slots in a queue; 0: it has none */
    /* Sent first while it is unknown whether the adapter echoes: its reply is never a copy of its request.
     * NULL: none. */
    const struct md_exchange *echo_probe;
    struct md_settings settings;
    int framing;
    int insists;          /* a stop: sent even where a late reply may pass for its own */
    uint32_t end;         /* the reply's one register is below this; 0: it holds anything */
    uint16_t least;       /* and not below this */
    uint8_t is_proof;     /* of its drive */
    uint8_t frame_len;    /* 0: the frame is built when its turn comes */
    uint8_t frame[MD_KEPT_FRAME];
    struct md_message request;
    int64_t turnaround_ns; /* after a broadcast */
    const uint32_t *stops; /* of its drive: sent only while they are stops_seen; NULL: always */
    uint32_t stops_seen;
};

/* The reason why an exchange has no reply; an enum md_frame_fault where something came in its place. */
enum md_failure {
    MD_CUT_SHORT = -9,         /* a reply began and did not end within the time-out */
    MD_NO_REPLY = -10,         /* nothing came within the time-out, but at most the request's echo */
    MD_LINE_LOST = -11,        /* the port failed: errno in `error`, 0 at end of file, EPROTO: no MD_TCP */
    MD_SETTINGS_REFUSED = -12, /* the port did not take baud rate or format */
    MD_LATE_ANSWER_DUE = -13,  /* not sent: a late reply could be mistaken for its own */
    MD_EXPIRED = -14,          /* not sent: its time was over, or a stop came first */
    MD_POLL_ENDED = -16,       /* the poll ended before its turn or its reply */
    MD_MAYBE_ECHO = -17,       /* the reply cannot be told from the adapter's echo */
    MD_NOT_MASTER = -19,       /* not sent: this process may not send any more; a part may have left before */
    MD_OTHER_MASTER = -20,     /* not sent: bytes come that another master causes */
    MD_POLLING_FAILED = -21    /* not asked: the client that queues requests failed */
};

/* The result of an exchange. first_ns and last_ns are 0 where nothing came. */
struct md_completion {
    int result;                /* > 0: length of the reply; 0: a broadcast, sent; < 0: see enum md_failure */
    int error;                 /* MD_LINE_LOST: errno; MD_SETTINGS_REFUSED: enum md_refusal */
    int64_t begun_ns;          /* its turn came: the line's silence may not have been over */
    int64_t sent_ns;           /* the request began to leave; 0: it never did */
    int64_t utc_ahead_ns;      /* UTC - CLOCK_MONOTONIC then, before any sleep of the machine; 0: not known */
    int64_t first_ns, last_ns; /* first and last byte after the request were seen */
    int64_t late_until_ns;     /* of an urgent one: its drive's, when its caller asked for it */
    uint32_t stale;            /* bytes thrown away before the request left: late replies, noise */
    uint32_t skipped;          /* bytes after the request that were not part of the reply */
    uint16_t raw_len;
    struct md_message reply;   /* a good reply or an exception */
    uint8_t raw[MD_MOST_FRAME]; /* the reply; of a failure the end of what came */
};

/* Progress of a port. Each number only grows, and wraps around. */
struct md_progress {
    uint32_t submitted, done;
    uint32_t lost;        /* the descriptor failed: all urgent ones that follow are MD_LINE_LOST */
    uint32_t cut_off;     /* the newest polled exchange was lost with it, after replies to others on it */
    uint32_t repeating;   /* exchanges are repeated */
    uint32_t switches;    /* of baud rate and format */
    uint32_t echo;        /* of its adapter (enum md_echo), as far as is known */
    uint32_t foreign;     /* bytes that came while the line was listened to before its first request */
    int64_t switching_ns; /* time that the switches took */
};

struct md_engine;
struct md_port;
struct md_row_queue;
struct md_tap;
struct md_mastership;

struct md_engine *md_engine_start(void); /* the thread for every line of the process; it ends with that */

/* `must_take`: the refusals (enum md_refusal) that are failures; -1: a port without settings. `transactions`:
 * enum md_transactions. `room` for queued exchanges is a power of two. */
struct md_port *md_port_open(struct md_engine *engine, int fd, int must_take, int transactions,
                             unsigned room);
/* Send only while the mastership holds: it is looked at right before each write(2), and must outlive the
 * port. Before the first request, and where it has not held all the time since the last one, the line is
 * listened to, for the mastership's guard at least; a stop is not held up. */
void md_port_fence(struct md_port *port, struct md_mastership *mastership);
/* Say who switches between sending and receiving, before anything is sent; return 0 or -errno. */
int md_port_rs485(struct md_port *port, int mode);
/* Put all that goes over the line into `tap`, which must outlive the port or be replaced first. */
void md_port_tap(struct md_port *port, struct md_tap *tap);
/* Begin nothing more of what is queued or repeated, but still urgent exchanges. Return 1 while one of the
 * former is under way. */
int md_port_end(struct md_port *port);
/* Return 1 while an exchange with this drive is queued, repeated, urgent or under way. */
int md_port_is_asking(struct md_port *port, const struct md_drive *drive);
/* Return until when the port's time is over and counted: no exchange that ends from now on needed the line
 * before then. While one is under way that is its beginning. */
int64_t md_port_counted_ns(struct md_port *port);
/* md_late_inherit() while the engine looks at neither drive. */
void md_port_inherit(struct md_port *port, struct md_drive *drive, const struct md_drive *before);
/* Carry out nothing more, and give the descriptor back. What is under way after md_port_end() becomes
 * MD_POLL_ENDED. */
void md_port_stop(struct md_port *port);
/* Stop and free it; `memory` is what its client keeps for it, and outlives this call. */
void md_port_let_go(struct md_port *port, void *memory);
/* Say whether the adapter echoes: MD_ECHO is never unlearnt, MD_NO_ECHO holds until an echo shows. */
void md_port_tell_echo(struct md_port *port, int echo);
/* Deliver rows to `row_queue`, and call it with `number` when the port needs attention. */
void md_port_report(struct md_port *port, struct md_row_queue *row_queue, uint32_t number);
/* Queue exchanges, none to be sent before its time; return how many there was room for. One client at a
 * time. A slot that is late by a period is not sent (MD_EXPIRED) when the same exchange's next one is due. */
int md_port_submit(struct md_port *port, const struct md_exchange *const *exchanges,
                   const int64_t *not_before_ns, int n);
/* Repeat these in turn while nothing that is queued is due, until they are replaced, the port is lost, or one
 * of them could not be sent. Return which one of those that they replace would have been next. */
unsigned md_port_repeat(struct md_port *port, const struct md_exchange *const *exchanges, unsigned n);
const struct md_progress *md_port_progress(struct md_port *port);
/* Count a stop: no urgent exchange made before it begins to leave any more. */
void md_count_stop(uint32_t *stops);
/* Carry one out ahead of the queue and wait for it; one that insists goes ahead of those that do not. After
 * `expires_ns` (of CLOCK_BOOTTIME; 0: never), or a stop, it is not sent (MD_EXPIRED). Beside many of these
 * the queue keeps a 20th of the line, one exchange at a time, but none while one that insists waits. Write
 * the exchange's values, NaN where the reply has none, and return how many it has; -1 where there is no good
 * reply, or an exception. */
int md_port_carry_out(struct md_port *port, const struct md_exchange *exchange, int64_t not_before_ns,
                      int64_t expires_ns, struct md_completion *completion, double *values);

/* ---- columns.c: return a count ---- */

/* Write the value of each of the block's fields in a good reply, NaN where it has none; return how many it
 * has. */
int md_values(const struct md_block *block, const struct md_message *reply, double *values);

/* ---- mastership.c, api.c: return NULL or -1 and set errno on failure; else a time, or a flag ---- */

int64_t md_boottime_ns(void); /* CLOCK_BOOTTIME, of which are the times below */
/* Make one that does not hold yet; ENOSYS where the kernel has no such timer. A line is listened to for
 * `guard_ns` at least. */
struct md_mastership *md_mastership_new(int64_t guard_ns);
void md_mastership_free(struct md_mastership *mastership); /* after all ports that have it */
/* Hold until then. Where it is not extended by `kill_ns`, the kernel kills this process. */
int md_mastership_extend(struct md_mastership *mastership, int64_t until_ns, int64_t kill_ns);
/* Hold no more: nothing is sent once this has returned, and nobody is killed. */
void md_mastership_end(struct md_mastership *mastership);
int64_t md_mastership_until_ns(const struct md_mastership *mastership); /* 0: it does not hold */
int md_mastership_holds(const struct md_mastership *mastership);

/* ---- rows ---- */

enum {
    MD_MOST_NUMBERS = 65536, /* of a row queue's ports */
    MD_MOST_INVALID = 8      /* counts of a register that mean no value */
};

/* ---- columns.c: return NULL where there is no memory; md_value a number, NaN where there is none ---- */

enum md_number_format {
    MD_U16, MD_I16, MD_U32, MD_I32, MD_U32_EITHER, MD_F32, MD_BIT,
    MD_I8, /* the low byte of a word */
    MD_U64, MD_I64, MD_F64, MD_BCD16, MD_BCD32, MD_F16,
    MD_LOW_WORD_FIRST = 0x40, /* added to a format of several words */
    MD_LOW_BYTE_FIRST = 0x80  /* added to any but MD_BIT: within each word */
};

/* Read the number at word (MD_BIT: bit) `at` of a reply's data: none where a BCD digit is above 9. */
double md_value(const uint8_t *data, size_t len, size_t at, int format);

/* A register's place in a block's reply, and its scale: value = raw * multiplier / divisor. */
struct md_field {
    uint16_t at;
    uint8_t format; /* enum md_number_format */
    uint16_t reg;   /* code of its name */
    uint16_t extra; /* 0: none; else it is the block's extra[extra - 1] */
    double multiplier, divisor;
};

/* Bits of a number that mean that there is no value: bits & mask == pattern. */
struct md_invalid {
    uint64_t mask, pattern;
};

/* The rest of a field, which few have. */
struct md_extra {
    double addend;         /* value = (raw * multiplier + addend) / divisor */
    uint8_t low, bits;     /* raw is so many bits of the number, from this one on; bits 0: the number */
    uint8_t scale_format;  /* of the number whose power of ten it is multiplied by, at word scale_at; */
    uint8_t has_scale;     /* beyond 10^-22 to 10^22 there is no value */
    uint16_t scale_at;
    uint8_t invalid_count, scale_invalid_count; /* the scale's follow on the number's own */
    struct md_invalid invalid[MD_MOST_INVALID];
};

/* The fields of a drive's reply. Drives of a kind share them. */
struct md_block {
    const struct md_field *fields;
    const struct md_extra *extra;
    int count;
    uint32_t refusals; /* exceptions in a row */
    uint32_t failures; /* exchanges in a row without a reply, or with a bad one */
    uint8_t refusal;   /* the last one's code */
    uint8_t may_lack;  /* a good reply may hold no value for some field */
    uint8_t is_answered; /* a good reply came once that was no exception */
    uint16_t drive;    /* code of its name */
};

/* A row's status: why it has no value. Any other is -enum md_failure or -enum md_frame_fault. */
enum md_status {
    MD_OK = 0,
    MD_NOT_ASKED = 15, /* the drive is silent and is given a rest */
    MD_NO_VALUE = 18,  /* the reply holds what the device gives in place of a value: NaN, an invalid count */
    MD_EXCEPTION = 256 /* + the exception's code */
};

/* Rows. All arrays have `room` elements. */
struct md_columns {
    int64_t *time, *sent;           /* of the request, UTC and monotonic; of its turn where it never left */
    int64_t *uncertainty;           /* ns until the reply began */
    uint16_t *drive, *reg, *status; /* enum md_status */
    double *value;
    uint8_t *valid;                 /* bitmap, least significant bit first: value and uncertainty exist */
    size_t rows, room;
};

struct md_columns *md_columns_new(size_t room);
void md_columns_free(struct md_columns *columns);

/* Write the names of `n` codes as an Arrow utf8 column: n + 1 offsets, and the text. Name i is
 * bytes[offsets[i]] to bytes[offsets[i + 1]]. Return the text's length; -1 where `room` is too small or a
 * code has no name. */
int64_t md_spell(const uint16_t *codes, size_t n, const uint8_t *bytes, const int32_t *offsets, size_t names,
                 int32_t *out_offsets, uint8_t *out, size_t room);

/* ---- columns.c, columns as recordings hold them: return 0 or -1, a place, or a code ---- */

/* The next float that is no less. */
void md_narrow_up(const int64_t *numbers, size_t n, float *out);
/* Whole numbers of floats, 0 where the bitmap `valid` (NULL: all are) has none; -1 where one is none. */
int md_widen(const float *numbers, const uint8_t *valid, size_t n, int64_t *out);
/* The numbers of codes below `known`; return the place of the first code whose number is negative, else n. */
size_t md_narrow_codes(const uint16_t *codes, size_t n, const int16_t *numbers, size_t known, uint8_t *out);
void md_widen_codes(const uint8_t *codes, size_t n, uint16_t *out);
uint16_t md_greatest_code(const uint16_t *codes, size_t n);
/* The places of a series' rows, of which there may be `n`; return how many there are. */
size_t md_find_codes(const uint16_t *drives, const uint16_t *registers, size_t n, uint16_t drive,
                     uint16_t reg, uint32_t *places);

/* ---- row_queue.c: return NULL where there is nothing, or no memory; else a number ---- */

/* Keep up to `most_chunks` chunks of rows; rows that come when all are full are dropped and counted. */
struct md_row_queue *md_row_queue_new(size_t chunk_rows, size_t most_chunks);
/* Free it, once no port reports to it and the chunks that were taken are given back. */
void md_row_queue_free(struct md_row_queue *row_queue);
/* Add rows for values that were due at a time and not asked for. */
void md_row_queue_miss(struct md_row_queue *row_queue, const struct md_block *block, int status,
                       int64_t due_ns);
struct md_columns *md_row_queue_take(struct md_row_queue *row_queue); /* the oldest chunk */
void md_row_queue_give_back(struct md_row_queue *row_queue, struct md_columns *columns);
size_t md_row_queue_chunks(struct md_row_queue *row_queue); /* with rows; the newest is still being filled */
uint64_t md_row_queue_dropped(struct md_row_queue *row_queue); /* rows */
void md_row_queue_call(struct md_row_queue *row_queue, uint32_t number); /* wake the client about this port */
/* Wait for a call, at most so long; write the numbers called, each once, and return how many. */
int md_row_queue_await(struct md_row_queue *row_queue, int64_t timeout_ns, uint32_t *numbers, int room);
/* cdef: end */

#endif
