/* The C core's whole contract: checksums, frames, one line as a state machine, columns.
 *
 * Frames are pure functions over the caller's bytes: no I/O, no allocation, no globals, no
 * callbacks. Every parser returns the bytes it consumed (> 0), MD_INCOMPLETE (0) when more are
 * needed, or the reason why these bytes are not what was looked for (< 0, enum md_result). */
#ifndef MULTIDROP_H
#define MULTIDROP_H

#include <stddef.h>
#include <stdint.h>

/* cdef: begin */
/* ---- checksum.c ---- */

uint16_t md_crc16(const uint8_t *bytes, size_t len); /* CRC-16/MODBUS; low byte goes first */
uint8_t md_lrc(const uint8_t *bytes, size_t len);    /* two's complement of the sum */
uint8_t md_sum(const uint8_t *bytes, size_t len);    /* Delixi's own: low byte of the sum */

/* ---- frame.c ---- */

enum md_framing { MD_RTU, MD_ASCII, MD_DELIXI };

enum {
    MD_MOST_DATA = 250,  /* data bytes of a frame: 125 registers */
    MD_MOST_FRAME = 513  /* ':' + 2 * 255 hex digits + CR LF */
};

enum md_result {
    MD_INCOMPLETE = 0,     /* so far so good: more bytes are needed */
    MD_NO_START = -1,      /* no frame begins here */
    MD_BAD_CHARACTER = -2, /* not an upper-case hex digit, or CR LF are not where they belong */
    MD_BAD_CHECKSUM = -3,
    MD_BAD_ADDRESS = -4,  /* another drive's */
    MD_BAD_FUNCTION = -5, /* not the request's function, nor its exception */
    MD_BAD_LENGTH = -6,   /* byte count or quantity is not what the request asked for */
    MD_BAD_ECHO = -7,     /* a write confirmed with another address or value */
    MD_BAD_REQUEST = -8,  /* this message cannot be a frame: a field is out of bounds */
    /* of a whole exchange (line.c) */
    MD_CUT_SHORT = -9,         /* a reply began and did not end within the time-out */
    MD_NO_REPLY = -10,         /* nothing came within the time-out, but at most the request's echo */
    MD_LINE_LOST = -11,        /* the port failed: completion.error is the errno, 0 at its end */
    MD_SETTINGS_REFUSED = -12, /* the port did not take baud rate or format */
    MD_LATE_ANSWER_DUE = -13,  /* not sent: an earlier answer would be mistaken for its reply */
    MD_EXPIRED = -14,          /* not sent: its time was over, or a stop came, before its turn */
    /* of a value that was due (only seen in columns) */
    MD_NOT_ASKED = -15,        /* the drive is silent and was given a rest */
    MD_POLL_ENDED = -16,       /* before its answer was there, or its turn came */
    /* and of a whole exchange again */
    MD_MAYBE_ECHO = -17        /* what could be the reply could be the adapter's echo */
};

/* One frame's meaning, whatever its framing. Which fields count depends on the function:
 *   01-04     request start, count         reply data
 *   05, 06    request and reply start, data (2 bytes)
 *   08        request and reply start (the subfunction), data (2 bytes)
 *   0F, 10    request start, count, data   reply start, count
 *   Delixi's  function is K, start is P1P0, data is D3..D0 (4 bytes); a reply to K = 03 carries
 *             its value in P1P0, and has it in data too
 * `exception` is 0, or the code of an exception reply; of Delixi's protocol K = F0, FC..FF. */
struct md_message {
    uint8_t address, function, exception;
    uint16_t start, count;
    uint16_t data_len;
    uint8_t data[250];
};

/* Write the frame to `out`, which has room for `room` bytes; its length, or MD_BAD_REQUEST. */
int md_build_request(int framing, const struct md_message *message, uint8_t *out, size_t room);
int md_build_reply(int framing, const struct md_message *message, uint8_t *out, size_t room);

/* A request to any address at the beginning of `bytes`: the drive's side. */
int md_parse_request(int framing, const uint8_t *bytes, size_t len, struct md_message *message);

/* The reply to `request` at the beginning of `bytes`: the master's side. */
int md_parse_reply(int framing, const uint8_t *bytes, size_t len,
                   const struct md_message *request, struct md_message *reply);

/* Length in bytes of the good reply to `request`; 0 when nobody answers (broadcast). */
int md_reply_length(int framing, const struct md_message *request);

/* Copy what the message has: most are much shorter than the longest. */
void md_copy_message(struct md_message *to, const struct md_message *from);

/* What two upper-case hex digits say; -1 where they are none. */
int md_hex_byte(const uint8_t digits[2]);

/* ---- port.c ---- */

struct md_settings {
    uint32_t baudrate;
    uint8_t databits; /* 7, 8 */
    char parity;      /* 'N', 'E', 'O' */
    uint8_t stopbits; /* 1, 2 */
};

enum md_refusal { MD_REFUSED_BAUDRATE = 1, MD_REFUSED_DATABITS = 2, MD_REFUSED_PARITY = 4, MD_REFUSED_STOPBITS = 8 };

/* Make the port raw with these settings, and read them back.
 * 0, a mask of what it did not take (enum md_refusal), or -errno. */
int md_port_set(int fd, const struct md_settings *settings);
/* Read the settings; 0 or -errno. */
int md_port_get(int fd, struct md_settings *settings);

/* ---- clock.c ---- */

int64_t md_now_ns(void); /* CLOCK_MONOTONIC */
/* What to add to it to have UTC: kept as long as it is right to 0.1 ms, so that a moment has one time,
 * in whichever recording it stands. */
int64_t md_utc_minus_monotonic_ns(void);

/* ---- reason.c ---- */

/* Why these bytes, which came in place of the reply, are none (enum md_result). */
int md_reason(int framing, const struct md_message *request, const uint8_t *bytes, size_t len);

/* ---- line.c: one line as a state machine; bytes and time come in as arguments ---- */

enum { MD_DELAY_BUCKETS = 128 };

/* What became of a drive's exchanges (counters.c). Values are those of the exchange's block, or one. */
struct md_counters {
    uint64_t exchanges, answered, values; /* the first eight: counted at every exchange, and side by side */
    uint64_t sent;        /* requests that began to leave */
    uint64_t stray_bytes; /* bytes that were no part of a reply */
    uint64_t ideal_ns;    /* what the answered exchanges had to take of the line, and no more than they took */
    int64_t longest_ns;   /* response delay */
    uint64_t late;        /* answers that came after their time-out */
    uint64_t delays[128]; /* replies, by their response delay: bucket n is from md_delay_edge(n) to that of n + 1 */
    uint64_t ended[18];   /* exchanges that were not answered, by -result; 0: broadcasts */
    uint64_t missed[18];  /* values, by -result */
    uint64_t exceptions, naks, busies; /* exchanges that ended with an exception; with code 7, 6 */
    uint32_t refused[256]; /* values, by exception code */
};

enum { MD_MOST_OWED = 12, MD_MOST_PROOFS = 4, MD_TIMES_KEPT = 6 };

/* A question whose answers may still come. */
struct md_owed {
    int64_t sent_ns[6]; /* when it left, the earliest time first; later ones that have no room count as that */
    uint32_t times;
    uint16_t start, count, reply_len;
    uint16_t least, most; /* of the answer, as in md_exchange */
    uint8_t framing, address, function, data_len;
    uint8_t data[4];
};

/* What is known of a drive: the bounds of its time-out are given, the rest is learnt from its
 * exchanges and starts as 0. A time-out runs from the request's last bit to the reply's first. */
struct md_drive {
    int64_t least_timeout_ns, most_timeout_ns;
    int64_t delay_ns, deviation_ns; /* the response delay, smoothed, and its mean deviation */
    int64_t patience_ns;            /* a longer time-out, learnt from answers that came late */
    int64_t late_until_ns;          /* until then an answer may come late, in any order */
    int64_t answered_ns;            /* what left before that has been answered, or never will be */
    uint32_t failures;              /* in a row */
    uint32_t owed_count, proof_count;
    const struct md_exchange *const *proofs; /* questions whose replies differ from each other's, and most others' */
    struct md_drive *next_late;     /* on the same line, whose answers may still come */
    struct md_counters counters;
    struct md_owed owed[12];
};

/* One request and all that is needed to carry it out; constant while it is in use. What every
 * exchange needs comes first: with many lines each of them comes from far away. */
struct md_exchange {
    struct md_drive *drive;
    struct md_block *block; /* what its reply holds; NULL: nobody makes rows of it */
    int64_t character_ns;   /* one character on the wire */
    int64_t silence_ns;     /* before the request and after its reply */
    int64_t turnaround_ns;  /* after a broadcast */
    int64_t period_ns;      /* between its slots in a queue; 0: it has none */
    struct md_settings settings;
    int framing;
    /* Goes first where nobody knows whether the adapter echoes: unlike this one's, its reply is never a
     * copy of its request. NULL: none does. */
    const struct md_exchange *echo_probe;
    int insists; /* not to wait for an earlier answer, which may pass for its own: a stop, that is looked at */
    int64_t timeout_ns;   /* at least so long its reply is waited for: a write's; 0: as learnt. One that insists
                             is waited for as long as answers are known to be late, but not beyond that */
    uint16_t least, most; /* the one register of its reply lies between these; most 0: it may hold anything */
    /* The stops of its drive (md_count_stop): sent only while there are no more than that. NULL: sent anyway. */
    const uint32_t *stops;
    uint32_t stops_seen;
    struct md_message request;
};

/* What became of it. Times are of CLOCK_MONOTONIC; first and last are 0 where nothing came. */
struct md_completion {
    int result;                /* > 0: length of the reply; 0: a broadcast, sent; else enum md_result */
    int error;                 /* MD_LINE_LOST: errno; MD_SETTINGS_REFUSED: enum md_refusal */
    int64_t begun_ns;          /* it was taken up: the line's silence may not have been over yet */
    int64_t sent_ns;           /* the request began to leave; 0: it never did */
    int64_t first_ns, last_ns; /* the first and the last byte after the request were seen */
    uint32_t stale;            /* bytes thrown away before the request left: late replies, noise */
    uint32_t skipped;          /* bytes after the request that were not part of the reply */
    uint16_t raw_len;
    struct md_message reply;   /* of a good reply or an exception */
    uint8_t raw[513];          /* the reply; a failure's: what came, its end where it is too long */
};

enum md_want {
    MD_DONE,  /* nothing: the completion is filled in */
    MD_WAIT,  /* to be left alone until wake_ns: nothing worth reading comes before */
    MD_WRITE, /* tx[tx_at] to tx[tx_len] written, as much as the port takes */
    MD_READ   /* bytes, or to be asked again at wake_ns */
};

enum md_echo { MD_ECHO_UNKNOWN, MD_ECHO, MD_NO_ECHO };

struct md_tap;

struct md_line {
    int state;
    int64_t quiet_ns;   /* since when nobody has been sending */
    int64_t silence_ns; /* demanded after what went last */
    int64_t wake_ns;
    int64_t give_up_ns; /* until then it waits for a babbling line to fall silent, or for the reply */
    int64_t begun_by_ns; /* the reply has begun by then, or it does not come in time */
    int64_t ready_ns;   /* before then nothing is worth reading */
    struct md_drive *late; /* the first of those whose answers may still come */
    const struct md_exchange *exchange;
    struct md_completion *completion;
    uint16_t tx_len, tx_at;
    uint16_t rx_len, rx_from; /* no reply begins before rx_from */
    int echo;                 /* of what the adapter sends (enum md_echo): learnt, never forgotten by failures */
    int echo_is_told;         /* to be there, and is not unlearnt */
    int echo_due;             /* a copy of the request is still to come, and is not its reply */
    int waited, looks;        /* since the request left: whether it was left alone, how often it was looked at */
    struct md_tap *tap;       /* is told of all that goes over the line; NULL: nobody is */
    uint32_t cut;             /* bytes of late answers that came since the request left */
    uint16_t sight_at, sight; /* where the reply may begin, and what there was of it at the first sight */
    uint16_t burst;           /* at most so many characters wait in the adapter; 0: it may be a whole reply */
    uint8_t tx[513], rx[1026];
};

void md_line_init(struct md_line *line, int64_t now_ns);
/* Take up an exchange; one that is barred by late answers ends at once. Nothing of it happens before the line's silence is over. */
void md_line_begin(struct md_line *line, const struct md_exchange *exchange,
                   struct md_completion *completion, int64_t now_ns);
int md_line_want(struct md_line *line, int64_t now_ns); /* enum md_want */
/* The port took bytes, some time between these two. */
void md_line_sent(struct md_line *line, size_t len, int64_t begun_ns, int64_t now_ns);
void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns);
/* End the exchange under way: the port failed, or it is not to be sent any more. */
void md_line_abandon(struct md_line *line, int result, int error);

/* ---- delay.c: what is learnt of a drive from the delays of its replies ---- */

/* How long after a request, beside its reply's own time, it is worth looking for that. */
int64_t md_look_ns(const struct md_drive *drive, int64_t character_ns);
int64_t md_timeout_ns(const struct md_exchange *exchange); /* how long its reply is waited for */
int64_t md_present_timeout_ns(const struct md_drive *drive); /* the same, of a read, and not of the next only */
int64_t md_vain_ns(const struct md_drive *drive); /* the same of its next one, if it stays silent */
/* It was answered after so long, at most so long where the reply was whole when first looked at; what to
 * take for its delay. */
int64_t md_learn_delay(struct md_drive *drive, int64_t delay_ns, int is_whole, int64_t character_ns);
/* An answer came so long after its request, or after the last of several; it gets more time from now on. */
void md_learn_lateness(struct md_drive *drive, int64_t delay_ns, int is_exact);
/* It was not answered, which takes back half of that. */
void md_learn_silence(struct md_drive *drive);
int64_t md_window_ns(const struct md_exchange *exchange); /* in which a late answer may come in any order */

/* ---- late.c: answers that come after their time-out ---- */

/* The question whose reply is to prove first that no earlier answer can be taken for this exchange's; NULL:
 * none is needed, or none would help. */
const struct md_exchange *md_late_proof(const struct md_exchange *exchange, int64_t now_ns);
/* The drive takes the place of another, whose answers may still come. */
void md_late_inherit(struct md_drive *drive, const struct md_drive *before);

/* ---- before.c: what is asked before an exchange ---- */

/* Zeroed, nothing was. */
struct md_before {
    const struct md_exchange *then; /* the exchange */
    uint64_t heard;                 /* from its drive, before the last proof */
    uint32_t proofs, is_told;       /* that were asked; its echo_probe was */
    uint32_t failures;              /* of its drive, before all of that */
};

/* What to ask next before the exchange; NULL: it is its turn. */
const struct md_exchange *md_before(struct md_before *before, const struct md_exchange *exchange, int echo, int64_t now_ns);
/* Its turn is over; 1: its reply may have been an earlier answer, and it is to be asked again. */
int md_is_asked_again(struct md_before *before, const struct md_exchange *exchange, const struct md_completion *completion);

/* ---- counters.c: what became of a drive's exchanges, counted ---- */

/* An exchange is over, as its completion says. */
void md_counters_end(struct md_counters *counters, const struct md_exchange *exchange, const struct md_completion *completion);
/* It was answered after this delay, and had to take so long of the line. */
void md_counters_answer(struct md_counters *counters, int64_t delay_ns, int64_t ideal_ns);
/* The least delay of a bucket; it is less than a part in 8 longer than that, but in the first and the last. */
int64_t md_delay_edge(int bucket);

/* ---- engine.c: the thread that runs every line of the process ---- */

struct md_engine;
struct md_port; /* a descriptor with its line */
struct md_row_queue;

struct md_engine *md_engine_start(void); /* it ends with the process; NULL: see errno */

/* `must_take`: which refusals (enum md_refusal) are failures; -1: a port without settings. `room`
 * for exchanges, a power of two. NULL: see errno. */
struct md_port *md_port_open(struct md_engine *engine, int fd, int must_take, unsigned room);
/* Tell a tap of all that goes over the line from now on; it must outlive the port, or another tap be told. */
void md_port_tap(struct md_port *port, struct md_tap *tap);
/* Nothing more of what is queued or repeated is begun; whether one of that is under way. Urgent
 * exchanges still are. */
int md_port_end(struct md_port *port);
/* md_late_inherit, while the thread looks at neither. */
void md_port_inherit(struct md_port *port, struct md_drive *drive, const struct md_drive *before);
/* Nothing more is carried out, and the descriptor is the caller's again. What is under way after
 * md_port_end() is MD_POLL_ENDED. */
void md_port_stop(struct md_port *port);
void md_port_free(struct md_port *port); /* a port that was stopped */
/* Who has the rows of what is carried out, and is called, by this number, when the port is to be looked at. */
/* Whether its adapter echoes (enum md_echo): MD_ECHO is never unlearnt, MD_NO_ECHO holds until one shows. */
void md_port_tell_echo(struct md_port *port, int echo);
void md_port_report(struct md_port *port, struct md_row_queue *row_queue, uint32_t number);
/* Queue exchanges, none to be sent before its time; how many there was room for. One client at a time.
 * A slot that is late by a period is not sent either (MD_EXPIRED) when the same exchange's next is due. */
int md_port_submit(struct md_port *port, const struct md_exchange *const *exchanges,
                   const int64_t *not_before_ns, int n);
/* Carry these out one after the other, and again, while nothing that is queued is due; until they are
 * replaced, the port is lost, or one of them could not be sent. Which of those before was the next. */
unsigned md_port_repeat(struct md_port *port, const struct md_exchange *const *exchanges, unsigned n);
/* How far the queue is: each number only grows, and wraps around. */
struct md_progress {
    uint32_t submitted, done;
    uint32_t lost;      /* the descriptor failed: all that comes is MD_LINE_LOST */
    uint32_t repeating; /* exchanges are carried out again and again */
    uint32_t switches;  /* of baud rate and format */
    uint32_t echo;      /* of its adapter, as far as is known (enum md_echo) */
    int64_t switching_ns; /* that they took */
};
const struct md_progress *md_port_progress(struct md_port *port);
/* Count a stop: no urgent exchange that was made before it begins to leave any more. */
void md_count_stop(uint32_t *stops);
/* Carry one out ahead of the queue and wait for it; one that insists goes ahead of all that do not. After
 * `expires_ns` (0: never), or once a stop was counted, it is not sent (MD_EXPIRED). Beside many of these the
 * queue keeps a 20th of the line, one exchange at a time, but none while one waits that insists. */
void md_port_carry_out(struct md_port *port, const struct md_exchange *exchange, int64_t not_before_ns,
                       int64_t expires_ns, struct md_completion *completion);

/* ---- row_queue.c: what the thread leaves for a client: rows, and calls to look at a port ---- */

/* Rows are kept in so many chunks; those that come when all are full are dropped, and counted. */
struct md_row_queue *md_row_queue_new(size_t chunk_rows, size_t most_chunks); /* NULL: see errno */
/* When no port reports to it; what was taken can still be given back. */
void md_row_queue_free(struct md_row_queue *row_queue);
/* Make rows of what became of an exchange, where it has a block. */
void md_row_queue_add(struct md_row_queue *row_queue, const struct md_block *block, const struct md_completion *completion);
/* The oldest rows, the caller's until they are given back; NULL when there are none. */
struct md_columns *md_row_queue_take(struct md_row_queue *row_queue);
void md_row_queue_give_back(struct md_row_queue *row_queue, struct md_columns *columns);
size_t md_row_queue_chunks(struct md_row_queue *row_queue); /* that hold rows; the newest is still being filled */
uint64_t md_row_queue_dropped(struct md_row_queue *row_queue); /* rows */
enum { MD_MOST_NUMBERS = 65536 };
/* Call the client that waits, about whatever it gave this number. */
void md_row_queue_call(struct md_row_queue *row_queue, uint32_t number);
/* Wait for a call, no longer than that; the numbers that were called, each once, and how many. */
int md_row_queue_await(struct md_row_queue *row_queue, int64_t timeout_ns, uint32_t *numbers, int room);

/* ---- columns.c: completions become columns ---- */

enum md_wire { MD_U16, MD_I16, MD_U32, MD_I32, MD_U32_SWAPPED, MD_I32_SWAPPED, MD_U32_EITHER, MD_F32, MD_F32_SWAPPED, MD_BIT };

/* The number at word (MD_BIT: bit) `at` of a reply's data; NaN where the data ends before it. */
double md_value(const uint8_t *data, size_t len, size_t at, int wire);

/* Where a register lies in a block's reply, and how it is scaled: value = raw * multiplier / divisor. */
struct md_field {
    uint16_t at;
    uint8_t wire;
    uint16_t reg; /* code of its name */
    double multiplier, divisor;
};

/* What replies of a drive hold. Drives of a kind share the fields. */
struct md_block {
    const struct md_field *fields;
    int count;
    uint32_t refusals; /* exceptions in a row */
    uint8_t refusal;   /* the last one's code */
    uint16_t drive;    /* code of its name */
};

/* Rows; all arrays have room for the same number. `valid` is a bitmap, least significant bit first. */
struct md_columns {
    /* UTC and monotonic ns of the request (of the time it was taken up, where it never left);
     * ns until the reply began */
    int64_t *time, *sent, *uncertainty;
    uint16_t *drive, *reg, *status;     /* status: 0, -result, or 256 + exception code */
    double *value;
    uint8_t *valid;                     /* value and uncertainty exist */
    size_t rows, room;
};

/* Columns without rows; NULL when there is no memory. */
struct md_columns *md_columns_new(size_t room);
void md_columns_free(struct md_columns *columns);

/* Append one row for each of the block's fields; the number of rows, or 0 when there is no room. */
int md_columns_add(struct md_columns *columns, const struct md_block *block,
                   const struct md_completion *completion, int64_t utc_minus_monotonic_ns);

/* Spell codes out as an Arrow utf8 column: name i is bytes[offsets[i]] to bytes[offsets[i + 1]].
 * Writes n + 1 offsets and the text; the text's length, or -1 when `room` is too small or a code has no name. */
int64_t md_spell(const uint16_t *codes, size_t n, const uint8_t *bytes, const int32_t *offsets,
                 size_t names, int32_t *out_offsets, uint8_t *out, size_t room);
/* ---- tap.c: what goes over a line, kept until it is taken as packets of a pcapng file ---- */

/* Who sent it, where that is known. Of the last two the master itself says that they are no frames. */
enum md_side {
    MD_EITHER_SIDE,
    MD_ASKING,
    MD_ANSWERING,
    MD_FAILED, /* came in place of a reply */
    MD_NOISE,  /* and this not even that: stray bytes, echo, late replies */
    MD_SIDES
};

/* A ring with one who puts and one who takes. Zeroed but for `ring` and `room` it is empty. */
struct md_tap {
    uint8_t *ring;
    uint32_t room;       /* bytes, a power of two */
    uint32_t put, taken; /* each has one writer, only grows, and wraps around */
    uint64_t lost;       /* bytes for which there was no room */
};

/* What stands before and behind the bytes of a packet. There are two for each side: of other
 * frames, and of such that begin with ':'. */
struct md_wrapping {
    const uint8_t *head, *tail;
    uint32_t head_len, tail_len; /* the tail's is a multiple of 4 */
};

void md_tap_put(struct md_tap *tap, int side, int64_t time_ns, const uint8_t *bytes, size_t len);
/* Take whole packets as long as there is room; their length. */
size_t md_tap_take(struct md_tap *tap, const struct md_wrapping *wrappings, uint32_t interface,
                   int64_t utc_minus_monotonic_ns, uint8_t *out, size_t room);
/* The packet with these bytes, of which the first tells what stands before them. */
size_t md_packet_length(const struct md_wrapping *wrappings, int side, uint8_t first, size_t len);
void md_put_packet(const struct md_wrapping *wrappings, uint32_t interface, int side, int64_t time_ns,
                   const uint8_t *bytes, size_t len, uint8_t *out);

/* ---- stream.c: bytes that were sniffed, in pieces ---- */

/* Bytes that came together, from `at` up to the next piece. */
struct md_piece {
    size_t at;
    int64_t time_ns;
    uint8_t side;           /* enum md_side */
    uint8_t is_after_pause; /* the line was silent before them: only a hint */
};

/* What was heard and not yet forgotten. */
struct md_stream {
    uint8_t *bytes;
    struct md_piece *pieces;
    size_t len, room, count, most; /* of the bytes, of the pieces */
    int is_all;                    /* nothing more is to be waited for */
};

struct md_splitter;

/* Append a piece; 0 when there is no room. */
int md_hear(struct md_stream *stream, const uint8_t *bytes, size_t len, struct md_piece piece);
/* Forget what was split. */
void md_forget(struct md_stream *stream, struct md_splitter *splitter);

/* ---- split.c: what was sniffed on a line, cut into frames of both directions ---- */

enum md_kind {
    MD_JUNK,    /* no frame */
    MD_REQUEST,
    MD_EITHER,  /* a request, or its copy that confirms it: what came before was not understood */
    MD_REPLY,   /* to the request before it */
    MD_STRAY    /* a reply whose request was not heard */
};

struct md_span {
    size_t at, len;
    int64_t time_ns; /* of the piece in which it begins, */
    int side;        /* as this is */
    int kind, framing;
    struct md_message message;
};

/* Zeroed, it is at the beginning. */
struct md_splitter {
    size_t at, piece;          /* what comes next */
    size_t junk;               /* bytes since the last frame */
    int is_in_step;            /* the last thing was a frame: requests and their copies alternate */
    int awaited, framing;      /* the reply to `request` */
    struct md_message request; /* the last one */
};

/* The next span of what was heard: 1; 0 when more must be heard first. Every byte is part of one
 * span. How the bytes came in does not matter but for pauses and sides; junk comes in any number of spans. */
int md_split(struct md_splitter *splitter, const struct md_stream *stream, struct md_span *span);

/* ---- decode.c: what was sniffed becomes columns ---- */

/* What a request's reply holds; key 0 where there is none. */
struct md_known {
    uint64_t key;
    const struct md_block *block;
};

/* Zeroed but for `known`, with a number of places that is a power of two, it is at the beginning. */
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
    MD_ALL_DECODED, /* but for what needs more to be heard */
    MD_NO_ROOM,     /* in the columns */
    MD_UNKNOWN      /* the request in `span`: md_know, and again */
};

/* Say what replies to this request hold; NULL: nothing that makes rows. 0 when the table is full. */
int md_know(struct md_decoder *decoder, int framing, const struct md_message *request,
            const struct md_block *block);
/* Make rows of every exchange that was heard, also of requests that nobody answered (enum md_decoded). */
int md_decode(struct md_decoder *decoder, const struct md_stream *stream, struct md_columns *columns);

/* ---- unpack.c: packets out of capture files ---- */

enum { MD_LINK_RTAC = 250, MD_LINK_EXPORTED = 252 }; /* all others: bare bytes */

/* One interface of a capture: a line. */
struct md_channel {
    uint32_t link;
    int has_sides;        /* the packets' directions are to be believed */
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
    MD_CHANNEL_FULL,  /* split what was heard on the channels, and again */
    MD_OTHER_BLOCK,   /* of a pcapng file, at `at`: the caller's to read */
    MD_CUT,           /* the file ends within a packet */
    MD_NONSENSE       /* what begins at `at` is no packet */
};

/* Append packets to what was heard on their channels (enum md_unpacked). */
int md_unpack(struct md_capture *capture);
/* cdef: end */

#endif
