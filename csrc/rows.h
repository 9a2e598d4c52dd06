/* Rows: the numbers in a drive's reply, columns of rows, and the queue that holds them. Python calls these
 * functions. */
#ifndef MULTIDROP_ROWS_H
#define MULTIDROP_ROWS_H

#include "multidrop.h"

/* cdef: start */
enum {
    MD_MOST_NUMBERS = 65536, /* limit of the ports that report to one row queue */
    MD_MOST_INVALID = 8      /* limit of the raw values of a register that mean "no value" */
};

/* ---- columns.c: md_columns_new() returns NULL if memory is short ---- */

enum md_number_format {
    MD_U16, MD_I16, MD_U32, MD_I32, MD_U32_EITHER, MD_F32, MD_BIT,
    MD_I8, /* the low byte of a 16-bit word */
    MD_U64, MD_I64, MD_F64, MD_BCD16, MD_BCD32, MD_F16,
    MD_LOW_WORD_FIRST = 0x40, /* flag for formats of several 16-bit words: low word first */
    MD_LOW_BYTE_FIRST = 0x80  /* flag for all formats except MD_BIT: low byte first in each word */
};

/* Read the number at the 16-bit word (MD_BIT: bit) `at` of a reply's data; NaN if a BCD digit is above 9. */
double md_value(const uint8_t *data, size_t len, size_t at, int format);

/* A register's place in a block's reply, and its scale: value = raw * multiplier / divisor. */
struct md_field {
    uint16_t at;
    uint8_t format; /* enum md_number_format */
    uint16_t reg;   /* code of the register's name */
    uint16_t extra; /* 0: no extra; otherwise the block's extra[extra - 1] */
    double multiplier, divisor;
};

/* A pattern of bits that means "no value": bits & mask == pattern. */
struct md_invalid {
    uint64_t mask, pattern;
};

/* Properties that few fields have. */
struct md_extra {
    double addend;         /* value = (raw * multiplier + addend) / divisor */
    uint8_t low, bits;     /* raw is `bits` bits of the number, from bit `low` on; bits 0: all of them */
    uint8_t scale_format;  /* format of the decimal exponent, which is the word scale_at */
    uint8_t has_scale;     /* 1: multiply by 10^exponent; no value outside of 10^-22 to 10^22 */
    uint16_t scale_at;
    uint8_t invalid_count, scale_invalid_count; /* patterns in `invalid`: for number, exponent */
    struct md_invalid invalid[MD_MOST_INVALID];
};

/* The fields of a drive's reply. Drives of the same model share them. */
struct md_block {
    const struct md_field *fields;
    const struct md_extra *extra;
    int count;
    uint32_t refusals; /* number of consecutive exceptions */
    uint32_t failures; /* number of consecutive exchanges without a good reply */
    uint8_t refusal;   /* code of the last exception */
    uint8_t may_lack;  /* a field may have no value in a good reply */
    uint8_t is_answered; /* a good reply has come, not only exceptions */
    uint16_t drive;    /* code of the drive's name */
};

/* The status of a row. If the exchange had no good reply, the status is the reason, an enum md_failure or
 * enum md_frame_fault, with its sign changed. */
enum md_status {
    MD_OK = 0,
    MD_NOT_ASKED = 15, /* not requested: the poller temporarily skips a silent drive */
    MD_NO_VALUE = 18,  /* the reply holds the device's mark for "no value": NaN, an invalid count */
    MD_EXCEPTION = 256 /* an exception; the exception's code is added to this number */
};

/* Rows. All arrays have `room` elements. */
struct md_columns {
    int64_t *time, *sent; /* UTC and monotonic time of sending; for an unsent request, of its turn */
    int64_t *uncertainty;           /* time between the request and the reply's first byte */
    uint16_t *drive, *reg, *status; /* enum md_status */
    double *value;
    uint8_t *valid;                 /* bitmap, least significant bit first; 1: value and uncertainty exist */
    size_t rows, room;
};

/* Write the values of the block's fields in a good reply, NaN for a missing value; return how many exist. */
int md_values(const struct md_block *block, const struct md_message *reply, double *values);

struct md_columns *md_columns_new(size_t room);
void md_columns_free(struct md_columns *columns);

/* Write the names of `n` codes as an Arrow utf8 column: n + 1 offsets, and the text. Name i is
 * bytes[offsets[i]] to bytes[offsets[i + 1]]. Return the text's length; -1 if `room` is too small or a code
 * has no name. */
int64_t md_spell(const uint16_t *codes, size_t n, const uint8_t *bytes, const int32_t *offsets, size_t names,
                 int32_t *out_offsets, uint8_t *out, size_t room);

/* ---- columns.c: columns in the format of recordings ---- */

/* Convert to floats, rounded up. */
void md_narrow_up(const int64_t *numbers, size_t n, float *out);
/* Convert floats to whole numbers. Write 0 for each float whose bit in `valid` is 0 (NULL: all are valid).
 * Return -1 if a number does not fit. */
int md_widen(const float *numbers, const uint8_t *valid, size_t n, int64_t *out);
/* Replace codes by their entries in `numbers`; return the index of the first code that is not below `known`
 * or has a negative entry; n: there is none. */
size_t md_narrow_codes(const uint16_t *codes, size_t n, const int16_t *numbers, size_t known, uint8_t *out);
void md_widen_codes(const uint8_t *codes, size_t n, uint16_t *out);
uint16_t md_greatest_code(const uint16_t *codes, size_t n);
/* Write the indexes of the rows with this drive and register to `places`, which has room for `n`; return how
 * many. */
size_t md_find_codes(const uint16_t *drives, const uint16_t *registers, size_t n, uint16_t drive,
                     uint16_t reg, uint32_t *places);

/* ---- row_queue.c: md_row_queue_new() returns NULL if memory is short, _take() if there are no rows ---- */

/* Return a queue of up to `most_chunks` chunks of rows. While all chunks are full, new rows are dropped and
 * counted. */
struct md_row_queue *md_row_queue_new(size_t chunk_rows, size_t most_chunks);
/* Free the queue as soon as no port reports to it and all taken chunks are given back. A garbage collector
 * releases them in any order. */
void md_row_queue_release(struct md_row_queue *row_queue);
/* Add rows for values that were due at `due_ns` but not requested. */
void md_row_queue_miss(struct md_row_queue *row_queue, const struct md_block *block, int status,
                       int64_t due_ns);
struct md_columns *md_row_queue_take(struct md_row_queue *row_queue); /* remove the oldest chunk */
void md_row_queue_give_back(struct md_row_queue *row_queue, struct md_columns *columns);
/* Return the number of chunks with rows, including the newest one, which is not full yet. */
size_t md_row_queue_chunks(struct md_row_queue *row_queue);
uint64_t md_row_queue_dropped(struct md_row_queue *row_queue); /* number of dropped rows */
void md_row_queue_call(struct md_row_queue *row_queue, uint32_t number); /* wake the client */
/* Wait for calls of md_row_queue_call(), at most `timeout_ns`. Write their numbers to `numbers`, each only
 * once, and return how many. */
int md_row_queue_await(struct md_row_queue *row_queue, int64_t timeout_ns, uint32_t *numbers, int room);
/* cdef: end */

#endif
