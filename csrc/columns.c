/* Make columns of completions: numbers in engineering units. */
#include "internal.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static const uint8_t bytes_of[] = {
    [MD_U16] = 2, [MD_I16] = 2, [MD_U32] = 4, [MD_I32] = 4, [MD_U32_SWAPPED] = 4,
    [MD_I32_SWAPPED] = 4, [MD_U32_EITHER] = 4, [MD_F32] = 4, [MD_F32_SWAPPED] = 4,
};

static double as_float(uint32_t bits)
{
    float value;
    memcpy(&value, &bits, sizeof value);
    return (double)value;
}

static int is_inside(size_t len, size_t at, int format)
{
    if (format == MD_BIT)
        return at / 8 < len;
    return format >= 0 && (size_t)format < sizeof bytes_of && at < len && 2 * at + bytes_of[format] <= len;
}

double md_value(const uint8_t *data, size_t len, size_t at, int format)
{
    if (!is_inside(len, at, format))
        return (double)NAN;
    if (format == MD_BIT) /* the first coil is the least significant bit of the first byte */
        return (data[at / 8] >> (at % 8)) & 1;
    const uint8_t *first = data + 2 * at;
    uint32_t one = md_get16(first), two = bytes_of[format] == 4 ? md_get16(first + 2) : 0;
    switch (format) {
    case MD_I16: return (int16_t)one;
    case MD_U32: return one << 16 | two;
    case MD_I32: return (int32_t)(one << 16 | two);
    case MD_U32_SWAPPED: return two << 16 | one;
    case MD_I32_SWAPPED: return (int32_t)(two << 16 | one);
    case MD_U32_EITHER: return one | two; /* word order not stated, and one of the words is 0 */
    case MD_F32: return as_float(one << 16 | two);
    case MD_F32_SWAPPED: return as_float(two << 16 | one);
    default: return one;
    }
}

struct md_columns *md_columns_new(size_t room)
{
    enum { WIDE = 4, NARROW = 3 }; /* columns of 8 and of 2 bytes */
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

static uint16_t status_of(const struct md_completion *completion, const struct md_field *field)
{
    const struct md_message *reply = &completion->reply;
    if (completion->result < 0)
        return (uint16_t)-completion->result;
    if (reply->exception)
        return (uint16_t)(MD_EXCEPTION + reply->exception);
    return is_inside(reply->data_len, field->at, field->format) ? MD_OK : -MD_BAD_LENGTH;
}

int md_columns_add(struct md_columns *columns, const struct md_block *block,
                   const struct md_completion *completion, int64_t utc_minus_monotonic_ns)
{
    if (columns->room - columns->rows < (size_t)block->count)
        return 0;
    const struct md_message *reply = &completion->reply;
    int64_t sent_ns = completion->sent_ns ? completion->sent_ns : completion->begun_ns;
    for (int i = 0; i < block->count; i++) {
        const struct md_field *field = &block->fields[i];
        size_t row = columns->rows++;
        uint16_t status = status_of(completion, field);
        columns->time[row] = sent_ns + utc_minus_monotonic_ns;
        columns->sent[row] = sent_ns;
        columns->uncertainty[row] = status ? 0 : completion->first_ns - sent_ns;
        columns->drive[row] = block->drive;
        columns->reg[row] = field->reg;
        columns->status[row] = status;
        columns->value[row] = status ? 0 : md_value(reply->data, reply->data_len, field->at, field->format) *
                                               field->multiplier / field->divisor;
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
