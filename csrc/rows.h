/* Rows that the C core makes of replies, and the queue in which they wait for Python, which calls these
 * functions. */
#ifndef MULTIDROP_ROWS_H
#define MULTIDROP_ROWS_H

#include <stddef.h>
#include <stdint.h>

/* cdef: begin */
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

/* ---- narrow.c, columns as recordings hold them: return 0 or -1, a place, or a code ---- */

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

struct md_row_queue;

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
