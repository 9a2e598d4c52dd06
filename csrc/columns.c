/* Columns from completions: numbers in engineering units, and columns in the format of recordings. */
#include "internal.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    FORMAT = MD_LOW_WORD_FIRST - 1, /* mask: the format without its byte order */
    DECIMALS = 22                   /* 10^22 is the greatest power of ten that a double holds exactly */
};

static const uint8_t words_of[FORMAT + 1] = { /* number of 16-bit words; 0: a bit, or no format */
    [MD_U16] = 1, [MD_I16] = 1, [MD_U32] = 2, [MD_I32] = 2, [MD_U32_EITHER] = 2,
    [MD_F32] = 2, [MD_BIT] = 0, [MD_I8] = 1, [MD_U64] = 4, [MD_I64] = 4,
    [MD_F64] = 4, [MD_BCD16] = 1, [MD_BCD32] = 2, [MD_F16] = 1,
};

static const double power_of_ten[] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                                      1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};
_Static_assert(sizeof power_of_ten / sizeof *power_of_ten == DECIMALS + 1, "every power has a place");

/* ---- one number ---- */

static int is_inside(size_t len, size_t at, int format)
{
    if (format == MD_BIT)
        return at / 8 < len;
    size_t words = words_of[format & FORMAT];
    return words && at < len && 2 * (at + words) <= len;
}

static uint64_t bits_of(const uint8_t *first, int format)
{
    int words = words_of[format & FORMAT], step = 2;
    if (format & MD_LOW_WORD_FIRST) {
        first += 2 * (words - 1);
        step = -2;
    }
    int high = format & MD_LOW_BYTE_FIRST ? 1 : 0;
    uint64_t bits = 0;
    for (int i = 0; i < words; i++, first += step)
        bits = bits << 16 | (uint64_t)(first[high] << 8 | first[1 - high]);
    return bits;
}

static double of_float(uint32_t bits)
{
    float value;
    memcpy(&value, &bits, sizeof value);
    return (double)value;
}

/* A half float has 5 bits of exponent and 10 of fraction. */
static double of_half(uint32_t bits)
{
    uint32_t sign = (bits & 0x8000) << 16, exponent = bits >> 10 & 0x1F, fraction = bits & 0x3FF;
    if (exponent == 0) /* subnormal: multiples of 2^-24 */
        return (sign ? -1.0 : 1.0) * fraction / 16777216;
    exponent = exponent == 0x1F ? 0xFF : exponent + 127 - 15;
    return of_float(sign | exponent << 23 | fraction << 13);
}

static double of_double(uint64_t bits)
{
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static double of_decimal(uint64_t digits)
{
    double value = 0;
    for (int shift = 28; shift >= 0; shift -= 4) {
        uint64_t digit = digits >> shift & 0xF;
        if (digit > 9)
            return (double)NAN;
        value = 10 * value + (double)digit;
    }
    return value;
}

static double number_of(uint64_t bits, int format)
{
    switch (format & FORMAT) {
    case MD_I8: return (int8_t)bits;
    case MD_I16: return (int16_t)bits;
    case MD_I32: return (int32_t)bits;
    case MD_I64: return (double)(int64_t)bits;
    case MD_U32_EITHER: return (double)((bits >> 16 | bits) & 0xFFFF); /* one of the two words is 0 */
    case MD_F32: return of_float((uint32_t)bits);
    case MD_F64: return of_double(bits);
    case MD_F16: return of_half((uint32_t)bits);
    case MD_BCD16:
    case MD_BCD32: return of_decimal(bits);
    default: return (double)bits;
    }
}

static int bit_at(const uint8_t *data, size_t at) /* coils start at the least significant bit */
{
    return data[at / 8] >> at % 8 & 1;
}

static uint32_t get32(const uint8_t *at, int low_word_first)
{
    uint32_t first = md_get16(at), second = md_get16(at + 2);
    return low_word_first ? second << 16 | first : first << 16 | second;
}

/* Read a number. The usual formats have a fast path without a loop, which takes half the time. */
static inline double number_at(const uint8_t *data, size_t at, int format)
{
    const uint8_t *first = data + 2 * at;
    switch (format) {
    case MD_U16: return md_get16(first);
    case MD_I16: return (int16_t)md_get16(first);
    case MD_U32: return get32(first, 0);
    case MD_I32: return (int32_t)get32(first, 0);
    case MD_F32: return of_float(get32(first, 0));
    case MD_F32 | MD_LOW_WORD_FIRST: return of_float(get32(first, 1));
    case MD_BIT: return bit_at(data, at);
    default: return number_of(bits_of(first, format), format);
    }
}

double md_value(const uint8_t *data, size_t len, size_t at, int format)
{
    return format >= 0 && is_inside(len, at, format) ? number_at(data, at, format) : (double)NAN;
}

/* ---- the value of a field ---- */

static int is_any(uint64_t bits, const struct md_invalid *invalid, int count)
{
    for (int i = 0; i < count; i++)
        if ((bits & invalid[i].mask) == invalid[i].pattern)
            return 1;
    return 0;
}

/* Return the number in the field's bits; in a signed format the highest bit is the sign. */
static double part_of(uint64_t bits, int format, const struct md_extra *extra)
{
    uint64_t mask = extra->bits < 64 ? (UINT64_C(1) << extra->bits) - 1 : UINT64_MAX;
    uint64_t part = bits >> extra->low & mask, sign = UINT64_C(1) << (extra->bits - 1);
    int is_signed = (format & FORMAT) == MD_I16 || (format & FORMAT) == MD_I32 || (format & FORMAT) == MD_I64;
    return is_signed ? (double)(int64_t)((part ^ sign) - sign) : (double)part;
}

static double scaled(double raw, const struct md_field *field, double addend, int power)
{
    double multiplier = power > 0 ? field->multiplier * power_of_ten[power] : field->multiplier;
    double divisor = power < 0 ? field->divisor * power_of_ten[-power] : field->divisor;
    return (raw * multiplier + addend) / divisor;
}

/* Return the field's value; NaN if the device reports that it has no value. */
static double value_with(const struct md_message *reply, const struct md_field *field,
                         const struct md_extra *extra)
{
    uint64_t bits = field->format == MD_BIT ? (uint64_t)bit_at(reply->data, field->at)
                                            : bits_of(reply->data + 2 * field->at, field->format);
    if (is_any(bits, extra->invalid, extra->invalid_count))
        return (double)NAN;
    double raw = extra->bits ? part_of(bits, field->format, extra) : number_of(bits, field->format);
    if (!extra->has_scale)
        return scaled(raw, field, extra->addend, 0);
    if (!is_inside(reply->data_len, extra->scale_at, extra->scale_format))
        return (double)NAN;
    uint64_t scale = bits_of(reply->data + 2 * extra->scale_at, extra->scale_format);
    int power = (int16_t)scale;
    if (is_any(scale, extra->invalid + extra->invalid_count, extra->scale_invalid_count) ||
        power < -DECIMALS || power > DECIMALS)
        return (double)NAN;
    return scaled(raw, field, extra->addend, power);
}

/* Return the row's status; if it is MD_OK, set `value`. */
static uint16_t find_value(const struct md_message *reply, const struct md_block *block,
                           const struct md_field *field, double *value)
{
    if (!is_inside(reply->data_len, field->at, field->format))
        return -MD_BAD_LENGTH;
    double found =
        field->extra ? value_with(reply, field, &block->extra[field->extra - 1])
                     : number_at(reply->data, field->at, field->format) * field->multiplier / field->divisor;
    if (isnan(found))
        return MD_NO_VALUE;
    *value = found + 0.0; /* turns -0.0 into 0.0 */
    return MD_OK;
}

uint64_t md_count_lacking(const struct md_block *block, const struct md_message *reply)
{
    uint64_t lacking = 0;
    double value;
    for (int i = 0; i < block->count; i++)
        lacking += find_value(reply, block, &block->fields[i], &value) == MD_NO_VALUE;
    return lacking;
}

int md_values(const struct md_block *block, const struct md_message *reply, double *values)
{
    int found = 0;
    for (int i = 0; i < block->count; i++) {
        values[i] = (double)NAN;
        found += find_value(reply, block, &block->fields[i], &values[i]) == MD_OK;
    }
    return found;
}

/* ---- rows ---- */

struct md_columns *md_columns_new(size_t room)
{
    /* number of columns with 8 bytes per row, and with 2 bytes per row */
    enum { WIDE = 4, NARROW = 3 };
    struct md_columns *columns = malloc(sizeof *columns + room * (WIDE * 8 + NARROW * 2) + (room + 7) / 8);
    if (!columns)
        return NULL;
    int64_t *wide = (int64_t *)(columns + 1);
    uint16_t *narrow = (uint16_t *)(wide + WIDE * room);
    *columns = (struct md_columns){
        .time = wide,
        .sent = wide + room,
        .uncertainty = wide + 2 * room,
        .value = (double *)(wide + 3 * room),
        .drive = narrow,
        .reg = narrow + room,
        .status = narrow + 2 * room,
        .valid = (uint8_t *)(narrow + NARROW * room),
        .room = room,
    };
    memset(columns->valid, 0, (room + 7) / 8);
    return columns;
}

void md_columns_free(struct md_columns *columns)
{
    free(columns);
}

static void set_bit(uint8_t *bits, size_t at, int on)
{
    uint8_t mask = (uint8_t)(1u << (at % 8));
    bits[at / 8] = (uint8_t)(on ? bits[at / 8] | mask : bits[at / 8] & ~mask);
}

/* Return the status that applies to all fields, or MD_OK if each field has its own. */
static uint16_t status_of(const struct md_completion *completion)
{
    if (completion->result < 0)
        return (uint16_t)-completion->result;
    return completion->reply.exception ? (uint16_t)(MD_EXCEPTION + completion->reply.exception) : MD_OK;
}

int md_columns_add(struct md_columns *columns, const struct md_block *block,
                   const struct md_completion *completion, int64_t utc_minus_monotonic_ns)
{
    if (columns->room - columns->rows < (size_t)block->count)
        return 0;
    int64_t sent_ns = completion->sent_ns ? completion->sent_ns : completion->begun_ns;
    uint16_t common = status_of(completion);
    size_t row = columns->rows;
    columns->rows += (size_t)block->count;
    for (const struct md_field *field = block->fields; row < columns->rows; field++, row++) {
        double value = 0;
        uint16_t status = common ? common : find_value(&completion->reply, block, field, &value);
        columns->time[row] = sent_ns + utc_minus_monotonic_ns;
        columns->sent[row] = sent_ns;
        columns->uncertainty[row] = status ? 0 : completion->first_ns - sent_ns;
        columns->drive[row] = block->drive;
        columns->reg[row] = field->reg;
        columns->status[row] = status;
        columns->value[row] = value;
        set_bit(columns->valid, row, status == 0);
    }
    return block->count;
}

int64_t md_spell(const uint16_t *codes, size_t n, const uint8_t *bytes, const int32_t *offsets, size_t names,
                 int32_t *out_offsets, uint8_t *out, size_t room)
{
    size_t used = 0;
    out_offsets[0] = 0;
    for (size_t i = 0; i < n; i++) {
        if (codes[i] >= names)
            return -1;
        int32_t from = offsets[codes[i]];
        size_t len = (size_t)(offsets[codes[i] + 1] - from);
        if (room - used < len || used + len > INT32_MAX)
            return -1;
        memcpy(out + used, bytes + from, len);
        used += len;
        out_offsets[i + 1] = (int32_t)used;
    }
    return (int64_t)used;
}

/* ---- columns in the format of recordings ---- */

static const float BEYOND = 0x1p63F; /* the least float that exceeds every int64 */

/* Return the next float towards plus infinity. The number is not zero. */
static float next_up(float number)
{
    uint32_t bits;
    memcpy(&bits, &number, sizeof bits);
    bits += number > 0 ? 1U : UINT32_MAX;
    memcpy(&number, &bits, sizeof bits);
    return number;
}

void md_narrow_up(const int64_t *numbers, size_t n, float *out)
{
    for (size_t i = 0; i < n; i++) {
        float near = (float)numbers[i];
        out[i] = near < BEYOND && (int64_t)near < numbers[i] ? next_up(near) : near;
    }
}

int md_widen(const float *numbers, const uint8_t *valid, size_t n, int64_t *out)
{
    for (size_t i = 0; i < n; i++) {
        int is_valid = !valid || (valid[i / 8] >> (i % 8) & 1);
        if (is_valid && !(numbers[i] >= -BEYOND && numbers[i] <= BEYOND))
            return -1;
        out[i] = !is_valid ? 0 : numbers[i] < BEYOND ? (int64_t)numbers[i] : INT64_MAX;
    }
    return 0;
}

size_t md_narrow_codes(const uint16_t *codes, size_t n, const int16_t *numbers, size_t known, uint8_t *out)
{
    for (size_t i = 0; i < n; i++) {
        if (codes[i] >= known || numbers[codes[i]] < 0)
            return i;
        out[i] = (uint8_t)numbers[codes[i]];
    }
    return n;
}

void md_widen_codes(const uint8_t *codes, size_t n, uint16_t *out)
{
    for (size_t i = 0; i < n; i++)
        out[i] = codes[i];
}

uint16_t md_greatest_code(const uint16_t *codes, size_t n)
{
    uint16_t greatest = 0;
    for (size_t i = 0; i < n; i++)
        greatest = codes[i] > greatest ? codes[i] : greatest;
    return greatest;
}

size_t md_find_codes(const uint16_t *drives, const uint16_t *registers, size_t n, uint16_t drive,
                     uint16_t reg, uint32_t *places)
{
    size_t found = 0;
    for (size_t i = 0; i < n; i++)
        if (drives[i] == drive && registers[i] == reg)
            places[found++] = (uint32_t)i;
    return found;
}
