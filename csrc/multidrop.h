/* The functions of the C core that Python calls; internal.h has those that only C calls.
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
    MD_KEPT_FRAME = 24,       /* a frame that its exchange keeps: of any read */
    MD_STATUSES = 19,         /* of a row without an exception */
    MD_EXCEPTION_CODES = 256,
    MD_DELAY_BUCKETS = 128,
    MD_MOST_OWED = 12,        /* requests of a drive whose replies may still come */
    MD_MOST_PROOFS = 4,
    MD_TIMES_KEPT = 6,        /* of the same request */
    MD_MOST_NUMBERS = 65536,  /* of a row queue's ports */
    MD_MOST_INVALID = 8       /* counts of a register that mean no value */
};

/* ---- checksum.c: return the checksum ---- */

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

/* ---- columns.c: return NULL where there is no memory; md_value a number, NaN where there is none ---- */

enum md_number_format {
    MD_U16, MD_I16, MD_U32, MD_I32, MD_U32_EITHER, MD_F32, MD_BIT,
    MD_I8, /* the low byte of a word */
    MD_U64, MD_I64, MD_F64, MD_BCD16, MD_BCD32,
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

/* ---- narrow.c: columns as recordings hold them ---- */

/* The next float that is no less. */
void md_narrow_up(const int64_t *numbers, size_t n, float *out);
/* Whole numbers of floats, 0 where the bitmap `valid` (NULL: all are) has none; -1 where one is none. */
int md_widen(const float *numbers, const uint8_t *valid, size_t n, int64_t *out);
/* The numbers of codes below `known`; return the place of the first code whose number is negative, else n. */
size_t md_narrow_codes(const uint16_t *codes, size_t n, const int16_t *numbers, size_t known, uint8_t *out);
void md_widen_codes(const uint8_t *codes, size_t n, uint16_t *out);

/* ---- delay.c, late.c, counters.c: what is known of a drive; return a time in ns ---- */

/* Counts of a drive's exchanges; all but longest_ns only grow. Values are those of the exchange's block. */
struct md_counters {
    uint64_t exchanges, answered, values;
    uint64_t sent;        /* requests that began to leave */
    uint64_t stray_bytes; /* bytes that were no part of a reply */
    uint64_t ideal_ns;    /* the least time on the line that the answered exchanges needed */
    int64_t longest_ns;   /* response delay */
    uint64_t late;        /* replies that came after their time-out */
};

/* A request whose replies may still come. */
struct md_owed {
    int64_t sent_ns[MD_TIMES_KEPT]; /* earliest first; later ones without room count as the last */
    uint32_t times;
    uint16_t start, count, reply_len;
    uint16_t least, most; /* of the reply, as in md_exchange */
    uint8_t framing, address, function, data_len;
    uint8_t data[4];
};

/* A request of Modbus TCP whose reply may still come. */
struct md_unanswered {
    int64_t sent_ns;
    uint16_t transaction;
    uint8_t address;
};

/* The same in parts, and requests whose replies may still come. */
struct md_history {
    uint64_t ended[MD_STATUSES];       /* exchanges without a reply, by status; MD_OK: broadcasts */
    uint64_t missed[MD_STATUSES];      /* values, by status */
    uint64_t exceptions, naks, busies; /* exchanges that ended with an exception; with code 7; with code 6 */
    uint32_t refused[MD_EXCEPTION_CODES]; /* values, by exception code */
    struct md_owed owed[MD_MOST_OWED];
    struct md_unanswered unanswered[MD_MOST_OWED]; /* the oldest first */
};

/* A drive: the bounds of its time-out and its interval are given, the rest is learnt from its exchanges and
 * begins as 0.
 * A time-out runs from the request's last bit to the reply's first. */
struct md_drive {
    int64_t least_timeout_ns, most_timeout_ns;
    int64_t delay_ns, deviation_ns; /* the response delay, smoothed, and its mean deviation */
    int64_t patience_ns;            /* a longer time-out, learnt from late replies */
    int64_t late_until_ns;          /* until then a late reply may come, in any order */
    int64_t answered_ns;            /* requests that left before then are answered, or never will be */
    int64_t interval_ns, ready_ns;  /* from the end of an exchange to its next request; not before then */
    uint32_t failures;              /* in a row */
    uint32_t owed_count, unanswered_count, proof_count;
    const struct md_exchange *const *proofs; /* reads whose replies differ from others' */
    struct md_drive *next_late;     /* the next one on this line with late replies due */
    struct md_history *history;     /* apart, for it is seldom needed: an exchange touches fewer pages */
    struct md_counters counters;
    uint64_t delays[MD_DELAY_BUCKETS]; /* replies by response delay: bucket n begins at md_delay_edge(n) */
};

int64_t md_present_timeout_ns(const struct md_drive *drive); /* of a read */
int64_t md_vain_ns(const struct md_drive *drive);            /* of the next read, if the drive stays silent */
int64_t md_delay_edge(int bucket); /* the least delay of a bucket, which is an eighth of that wide */
/* Hand over the late replies that are due of another drive, whose place this one takes. */
void md_late_inherit(struct md_drive *drive, const struct md_drive *before);

/* ---- engine.c, port_api.c: return NULL and set errno on failure; counts and flags else ---- */

enum md_echo { MD_ECHO_UNKNOWN, MD_ECHO, MD_NO_ECHO };

/* The framing of a port's exchanges. */
enum md_transactions {
    MD_NO_TRANSACTIONS, /* any but MD_TCP */
    MD_MATCHED,         /* MD_TCP: a reply has its request's id */
    MD_IGNORED          /* MD_TCP through a gateway that replies with ids of its own */
};

/* One request with all that is needed to carry it out; constant while in use. What every exchange needs comes
 * first: with many lines each cache line of it is read from memory. */
struct md_exchange {
    struct md_drive *drive;
    struct md_block *block; /* fields of its reply; NULL: no rows */
    int64_t character_ns;   /* one character on the wire */
    int64_t silence_ns;     /* before the request and after its reply */
    /* The least time-out, of a write; 0: as learnt. One that insists waits as long as late replies are
     * known to take, but not beyond this. */
    int64_t timeout_ns;
    /* Sent first while it is unknown whether the adapter echoes: its reply is never a copy of its request.
     * NULL: none. */
    const struct md_exchange *echo_probe;
    struct md_settings settings;
    int framing;
    int insists;          /* a stop: sent even where a late reply may pass for its own */
    uint16_t least, most; /* the reply's one register lies between these; most 0: anything */
    uint8_t frame_len;    /* 0: the frame is built when its turn comes */
    uint8_t frame[MD_KEPT_FRAME];
    struct md_message request;
    int64_t turnaround_ns; /* after a broadcast */
    int64_t period_ns;     /* between its slots in a queue; 0: it has none */
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
    MD_MAYBE_ECHO = -17        /* the reply cannot be told from the adapter's echo */
};

/* The result of an exchange. first_ns and last_ns are 0 where nothing came. */
struct md_completion {
    int result;                /* > 0: length of the reply; 0: a broadcast, sent; < 0: see enum md_failure */
    int error;                 /* MD_LINE_LOST: errno; MD_SETTINGS_REFUSED: enum md_refusal */
    int64_t begun_ns;          /* its turn came: the line's silence may not have been over */
    int64_t sent_ns;           /* the request began to leave; 0: it never did */
    int64_t first_ns, last_ns; /* first and last byte after the request were seen */
    uint32_t stale;            /* bytes thrown away before the request left: late replies, noise */
    uint32_t skipped;          /* bytes after the request that were not part of the reply */
    uint16_t raw_len;
    struct md_message reply;   /* a good reply or an exception */
    uint8_t raw[MD_MOST_FRAME]; /* the reply; of a failure the end of what came */
};

/* Progress of a port. Each number only grows, and wraps around. */
struct md_progress {
    uint32_t submitted, done;
    uint32_t lost;        /* the descriptor failed: all that follows is MD_LINE_LOST */
    uint32_t repeating;   /* exchanges are repeated */
    uint32_t switches;    /* of baud rate and format */
    uint32_t echo;        /* of its adapter (enum md_echo), as far as is known */
    int64_t switching_ns; /* time that the switches took */
};

struct md_engine;
struct md_port;
struct md_row_queue;
struct md_tap;

struct md_engine *md_engine_start(void); /* the thread for every line of the process; it ends with that */

/* `must_take`: the refusals (enum md_refusal) that are failures; -1: a port without settings. `transactions`:
 * enum md_transactions. `room` for queued exchanges is a power of two. */
struct md_port *md_port_open(struct md_engine *engine, int fd, int must_take, int transactions,
                             unsigned room);
/* Put all that goes over the line into `tap`, which must outlive the port or be replaced first. */
void md_port_tap(struct md_port *port, struct md_tap *tap);
/* Begin nothing more of what is queued or repeated, but still urgent exchanges. Return 1 while one of the
 * former is under way. */
int md_port_end(struct md_port *port);
/* Return 1 while an exchange with this drive is queued, repeated, urgent or under way. */
int md_port_is_asking(struct md_port *port, const struct md_drive *drive);
/* md_late_inherit() while the engine looks at neither drive. */
void md_port_inherit(struct md_port *port, struct md_drive *drive, const struct md_drive *before);
/* Carry out nothing more, and give the descriptor back. What is under way after md_port_end() becomes
 * MD_POLL_ENDED. */
void md_port_stop(struct md_port *port);
void md_port_free(struct md_port *port); /* after md_port_stop() */
/* Say whether the adapter echoes: MD_ECHO is never unlearnt, MD_NO_ECHO holds until an echo shows. */
void md_port_tell_echo(struct md_port *port, int echo);
/* Deliver rows to `row_queue`, and call it with `number` when the port needs attention. */
void md_port_report(struct md_port *port, struct md_row_queue *row_queue, uint32_t number);
/* Queue exchanges, none to be sent before its time; return how many there was room for. One client at a
 * time. A slot that is late by a period is not sent (MD_EXPIRED) when the same exchange's next one is due. */
int md_port_submit(struct md_port *port, const struct md_exchange *const *exchanges,
                   const int64_t *not_before_ns, int n);
/* Repeat these in turn while nothing that is queued is due, until they are replaced, the port is lost, or one
 * of them could not be sent. Return which one of those before would have been next. */
unsigned md_port_repeat(struct md_port *port, const struct md_exchange *const *exchanges, unsigned n);
const struct md_progress *md_port_progress(struct md_port *port);
/* Count a stop: no urgent exchange made before it begins to leave any more. */
void md_count_stop(uint32_t *stops);
/* Carry one out ahead of the queue and wait for it; one that insists goes ahead of those that do not. After
 * `expires_ns` (0: never), or after a stop, it is not sent (MD_EXPIRED). Beside many of these the queue keeps
 * a 20th of the line, one exchange at a time, but none while one that insists waits. */
void md_port_carry_out(struct md_port *port, const struct md_exchange *exchange, int64_t not_before_ns,
                       int64_t expires_ns, struct md_completion *completion);

/* ---- row_queue.c: return NULL where there is nothing, or no memory; else a number ---- */

/* Keep up to `most_chunks` chunks of rows; rows that come when all are full are dropped and counted. */
struct md_row_queue *md_row_queue_new(size_t chunk_rows, size_t most_chunks);
/* Free it once no port reports to it. Chunks taken before may be given back afterwards. */
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

/* ---- tap.c: return a length in bytes ---- */

/* The sender, where it is known. The last two are no frames by the master's own account. */
enum md_side {
    MD_EITHER_SIDE,
    MD_ASKING,
    MD_ANSWERING,
    MD_FAILED, /* came in place of a reply */
    MD_NOISE,  /* stray bytes, echo, late replies */
    MD_SIDES
};

/* A ring with one writer and one reader. Zeroed but for `ring` and `room` it is empty. */
struct md_tap {
    uint8_t *ring;
    uint32_t room;       /* bytes, a power of two */
    uint32_t put, taken; /* each has one writer, only grows, and wraps around */
    uint64_t lost;       /* bytes without room */
};

/* Header and trailer of a packet. Each side has two: for any bytes, and for those that begin with ':'. */
struct md_wrapping {
    const uint8_t *head, *tail;
    uint32_t head_len, tail_len; /* the tail's is a multiple of 4 */
};

/* Write whole pcapng packets to `out` while there is room. */
size_t md_tap_take(struct md_tap *tap, const struct md_wrapping *wrappings, uint32_t interface,
                   int64_t utc_minus_monotonic_ns, uint8_t *out, size_t room);
/* Return the length of the packet with `len` bytes that begin with `first`. */
size_t md_packet_length(const struct md_wrapping *wrappings, int side, uint8_t first, size_t len);
void md_put_packet(const struct md_wrapping *wrappings, uint32_t interface, int side, int64_t time_ns,
                   const uint8_t *bytes, size_t len, uint8_t *out);

/* ---- split.c: return 1; 0 when room (md_stream_put) or more bytes (md_split) are needed ---- */

/* Bytes that came together, from `at` up to the next piece. */
struct md_piece {
    size_t at;
    int64_t time_ns;
    uint8_t side;           /* enum md_side */
    uint8_t is_after_pause; /* the line was silent before them: a hint */
};

/* Sniffed bytes that are not yet forgotten. */
struct md_stream {
    uint8_t *bytes;
    struct md_piece *pieces;
    size_t len, room, count, most; /* of the bytes, of the pieces */
    int is_all;                    /* nothing more will come */
    int is_tcp;                    /* all frames are MD_TCP's; else none is */
};

enum md_kind {
    MD_JUNK,    /* no frame */
    MD_REQUEST,
    MD_EITHER,  /* a request, or its copy that confirms it: what came before was not understood */
    MD_REPLY,   /* to the request before it */
    MD_STRAY    /* a reply without its request */
};

/* Sniffed bytes that belong together. */
struct md_span {
    size_t at, len;
    int64_t time_ns; /* time and side of the piece in which it begins */
    int side;
    int kind, framing;
    struct md_message message;
};

/* Zeroed, it is at the beginning. */
struct md_splitter {
    size_t at, piece;          /* what comes next */
    size_t junk;               /* bytes since the last frame */
    int is_in_step;            /* a frame came last: requests and their copies alternate */
    int awaited, framing;      /* of the reply to `request` */
    struct md_message request; /* the last one */
};

/* Append a piece. */
int md_stream_put(struct md_stream *stream, const uint8_t *bytes, size_t len, struct md_piece piece);
/* Forget what was split. */
void md_stream_forget(struct md_stream *stream, struct md_splitter *splitter);
/* Find the next span. Every byte is part of one. Only pauses and sides matter of how the bytes came in; junk
 * comes in any number of spans. */
int md_split(struct md_splitter *splitter, const struct md_stream *stream, struct md_span *span);

/* ---- decode.c: return an enum md_decoded ---- */

/* The fields of a request's reply; key 0: an empty place. */
struct md_known {
    uint64_t key;
    const struct md_block *block;
};

/* Zeroed but for `known` and `places`, a power of two, it is at the beginning. */
struct md_decoder {
    struct md_splitter splitter;
    struct md_span span;
    struct md_known *known;
    size_t places, taken;
    const struct md_block *block; /* of the last request */
    int64_t asked_ns;
    int is_sure, failure;         /* it was a request; why it has no reply, if none comes */
    int is_due;                   /* `span` is still to be dealt with */
    uint64_t frames, exchanges, junk, strays;
    struct md_completion completion;
};

enum md_decoded {
    MD_ALL_DECODED, /* but for what needs more bytes */
    MD_NO_ROOM,     /* in the columns */
    MD_UNKNOWN      /* the request in `span`: call md_know(), and again */
};

/* Say what replies to this request hold; NULL: nothing that makes rows. Return 0 when the table is full. */
int md_know(struct md_decoder *decoder, int framing, const struct md_message *request,
            const struct md_block *block);
/* Add the rows of every sniffed exchange, also of requests without a reply. */
int md_decode(struct md_decoder *decoder, const struct md_stream *stream, struct md_columns *columns);

/* ---- unpack.c: return an enum md_unpacked ---- */

enum { MD_LINK_RTAC = 250, MD_LINK_EXPORTED = 252 }; /* link types with a header; all others: bare bytes */

/* One interface of a capture: a line. */
struct md_channel {
    uint32_t link;
    int has_sides;        /* the packets' directions are right */
    uint64_t ticks_per_s; /* of the packets' time stamps */
    int64_t offset_ns;
    struct md_stream stream;
};

struct md_capture {
    const uint8_t *bytes;
    size_t len, at;
    int is_pcapng, is_big_endian;
    struct md_channel *channels;
    size_t count;
};

enum md_unpacked {
    MD_UNPACKED,      /* all of it */
    MD_CHANNEL_FULL,  /* split what the channels hold, and again */
    MD_OTHER_BLOCK,   /* of a pcapng file, at `at`: for the caller to read */
    MD_CUT,           /* the file ends within a packet */
    MD_NONSENSE       /* no packet begins at `at` */
};

/* Append packets to their channels' streams. */
int md_unpack(struct md_capture *capture);
/* cdef: end */

#endif
