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
    /* of a value that was due (only seen in columns) */
    MD_NOT_ASKED = -13         /* the drive is silent and was given a rest */
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

/* ---- line.c: one line as a state machine; bytes and time come in as arguments ---- */

/* One request and all that is needed to carry it out; constant while it is in use. */
struct md_exchange {
    int framing;
    struct md_message request;
    struct md_settings settings;
    int64_t character_ns;   /* one character on the wire */
    int64_t silence_ns;     /* before the request and after its reply */
    int64_t timeout_ns;     /* from the request's last bit to the reply's first character */
    int64_t turnaround_ns;  /* after a broadcast */
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
    struct md_message reply;   /* of a good reply or an exception */
    uint16_t raw_len;
    uint8_t raw[513];          /* the reply; a failure's: what came, its end where it is too long */
};

enum md_want {
    MD_DONE,  /* nothing: the completion is filled in */
    MD_WRITE, /* tx[tx_at] to tx[tx_len] written, as much as the port takes */
    MD_READ   /* bytes, or to be asked again at wake_ns */
};

struct md_line {
    int state;
    int64_t quiet_ns;   /* since when nobody has been sending */
    int64_t silence_ns; /* demanded after what went last */
    int64_t wake_ns;
    int64_t give_up_ns; /* until then it waits for a babbling line to fall silent; then it sends */
    const struct md_exchange *exchange;
    struct md_completion *completion;
    uint16_t tx_len, tx_at;
    uint16_t rx_len, rx_from; /* no reply begins before rx_from */
    int echoes;               /* the adapter echoes what it sends: learnt, never forgotten by failures */
    int echo_due;             /* a copy of the request is still to come, and is not its reply */
    uint8_t tx[513], rx[1026];
};

void md_line_init(struct md_line *line, int64_t now_ns);
/* Take up an exchange; nothing of it happens before the line's silence is over. */
void md_line_begin(struct md_line *line, const struct md_exchange *exchange,
                   struct md_completion *completion, int64_t now_ns);
int md_line_want(struct md_line *line, int64_t now_ns); /* enum md_want */
void md_line_sent(struct md_line *line, size_t len, int64_t now_ns);
void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns);
/* The port failed: ends the exchange under way. */
void md_line_lost(struct md_line *line, int result, int error);

/* ---- engine.c: lines driven on descriptors ---- */

/* A descriptor with its line. */
struct md_port {
    int fd;
    int must_take;   /* which refusals (enum md_refusal) are failures; -1: a port without settings */
    struct md_settings settings; /* in force; baudrate 0: not yet set */
    int yield_now;   /* atomic: other than 0 makes md_run return after the exchange under way */
    struct md_line line;
};

int64_t md_now_ns(void); /* CLOCK_MONOTONIC */
void md_port_init(struct md_port *port, int fd, int must_take);
void md_port_yield(struct md_port *port, int yield_now);
/* Carry out `n` exchanges one after another; how many were completed. Fewer when the port fails
 * (the last completion says so) or when asked to yield. Blocks. */
int md_run(struct md_port *port, const struct md_exchange *const *exchanges,
           struct md_completion *completions, int n);

/* ---- columns.c: completions become columns ---- */

enum md_wire { MD_U16, MD_I16, MD_U32, MD_I32, MD_U32_SWAPPED, MD_I32_SWAPPED, MD_U32_EITHER, MD_F32, MD_F32_SWAPPED, MD_BIT };

/* The number at word (MD_BIT: bit) `at` of a reply's data; NaN where the data ends before it. */
double md_value(const uint8_t *data, size_t len, size_t at, int wire);

/* Where a register lies in a block's reply, and how it is scaled: value = raw * multiplier / divisor. */
struct md_field {
    uint16_t at;
    uint8_t wire;
    uint16_t drive, reg; /* codes of their names */
    double multiplier, divisor;
};

struct md_block {
    const struct md_field *fields;
    int count;
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

/* Append one row for each of the block's fields; the number of rows, or 0 when there is no room. */
int md_columns_add(struct md_columns *columns, const struct md_block *block,
                   const struct md_completion *completion, int64_t utc_minus_monotonic_ns);

/* Spell codes out as an Arrow utf8 column: name i is bytes[offsets[i]] to bytes[offsets[i + 1]].
 * Writes n + 1 offsets and the text; the text's length, or -1 when `room` is too small. */
int64_t md_spell(const uint16_t *codes, size_t n, const uint8_t *bytes, const int32_t *offsets,
                 int32_t *out_offsets, uint8_t *out, size_t room);
/* cdef: end */

#endif
