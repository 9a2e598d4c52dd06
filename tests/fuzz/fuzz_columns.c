/* Decode values from hostile replies with hostile field declarations, and join names by hostile codes.
 *
 * An input is a header (result, room, and so on), four fields of a block, and the reply's data. */
#include "fuzz.h"

#include <math.h>

enum { HEADER = 8, FIELD = 6, FIELDS = 4, MOST = HEADER + FIELDS * FIELD + MD_MOST_DATA };

static const struct {
    size_t bytes;
    int is_signed, is_float, is_decimal;
} known[] = {
    [MD_U16] = {2, 0, 0, 0}, [MD_I16] = {2, 1, 0, 0}, [MD_U32] = {4, 0, 0, 0}, [MD_I32] = {4, 1, 0, 0},
    [MD_U32_EITHER] = {4, 0, 0, 0}, [MD_F32] = {4, 0, 1, 0}, [MD_BIT] = {0, 0, 0, 0}, [MD_I8] = {2, 1, 0, 0},
    [MD_U64] = {8, 0, 0, 0}, [MD_I64] = {8, 1, 0, 0}, [MD_F64] = {8, 0, 1, 0}, [MD_BCD16] = {2, 0, 0, 1},
    [MD_BCD32] = {4, 0, 0, 1}, [MD_F16] = {2, 0, 1, 0},
};

/* Return a value as an independent implementation decodes it: byte by byte and digit by digit. */
static double expected(const uint8_t *data, size_t len, size_t at, int wire)
{
    if (wire == MD_BIT)
        return at < 8 * len ? data[at / 8] / (1 << at % 8) % 2 : (double)NAN;
    int format = wire & 0x3F, swap = wire & MD_LOW_BYTE_FIRST ? 1 : 0;
    if (wire < 0 || format > MD_F16 || format == MD_BIT)
        return (double)NAN;
    size_t bytes = known[format].bytes;
    if (at > len || 2 * at + bytes > len)
        return (double)NAN;
    const uint8_t *first = data + 2 * at;
    uint8_t big[8];
    for (size_t i = 0; i < bytes; i++) {
        size_t from = wire & MD_LOW_WORD_FIRST ? (bytes - 2 - i / 2 * 2) + i % 2 : i;
        big[i] = first[swap ? from ^ 1 : from];
    }
    if (format == MD_U32_EITHER)
        return 256.0 * (big[0] | big[2]) + (big[1] | big[3]);
    uint64_t value = 0;
    double decimal = 0;
    for (size_t i = 0; i < bytes; i++) {
        value = 256 * value + big[i];
        if (known[format].is_decimal && (big[i] / 16 > 9 || big[i] % 16 > 9))
            return (double)NAN;
        decimal = 100 * decimal + 10 * (big[i] / 16) + big[i] % 16;
    }
    if (known[format].is_decimal)
        return decimal;
    if (format == MD_F32) {
        uint32_t bits = (uint32_t)value;
        float number;
        memcpy(&number, &bits, sizeof number);
        return (double)number;
    }
    if (format == MD_F16) {
        int exponent = big[0] / 4 % 32, fraction = big[0] % 4 * 256 + big[1];
        if (exponent == 31 && fraction)
            return (double)NAN;
        double size = exponent == 31 ? (double)INFINITY
                      : exponent    ? ldexp(1024 + fraction, exponent - 25)
                                    : ldexp(fraction, -24);
        return big[0] > 127 ? -size : size;
    }
    if (format == MD_F64) {
        double number;
        memcpy(&number, &value, sizeof number);
        return number;
    }
    if (format == MD_I8)
        return big[1] > 127 ? (double)big[1] - 256 : (double)big[1];
    if (known[format].is_signed && big[0] > 127)
        return -(double)(bytes == 8 ? ~value + 1 : (UINT64_C(1) << 8 * bytes) - value);
    return (double)value;
}

/* Return a field's value like `expected`, with its addend, scale register, invalid values and bit range. */
static double expected_with(const uint8_t *data, size_t len, const struct md_field *field,
                            const struct md_extra *extra)
{
    if (field->format == MD_BIT && !extra->has_scale && !extra->invalid_count && !extra->bits)
        return (expected(data, len, field->at, MD_BIT) * field->multiplier + extra->addend) / field->divisor;
    double value = expected(data, len, field->at, field->format);
    uint64_t bits = 0;
    int format = field->format & 0x3F;
    size_t bytes = format <= MD_F16 && format != MD_BIT ? known[format].bytes : 0;
    if (field->format == MD_BIT) {
        if (isnan(value))
            return value;
        bits = (uint64_t)value;
    } else {
        if (bytes == 0 || field->at > len || 2 * field->at + bytes > len)
            return (double)NAN;
        for (size_t word = 0; word < bytes / 2; word++) {
            size_t from = field->at + (field->format & MD_LOW_WORD_FIRST ? bytes / 2 - 1 - word : word);
            bits = bits * 65536 +
                   (uint64_t)expected(data, len, from, MD_U16 | (field->format & MD_LOW_BYTE_FIRST));
        }
    }
    for (int i = 0; i < extra->invalid_count; i++)
        if (((bits ^ extra->invalid[i].pattern) & extra->invalid[i].mask) == 0 &&
            (extra->invalid[i].pattern & ~extra->invalid[i].mask) == 0)
            return (double)NAN;
    if (extra->bits) {
        uint64_t part = 0;
        for (int i = extra->bits - 1; i >= 0; i--)
            part = 2 * part + (extra->low + i < 64 ? bits >> (extra->low + i) & 1 : 0);
        int is_signed = format == MD_I16 || format == MD_I32 || format == MD_I64;
        value = (double)part;
        if (is_signed && part >> (extra->bits - 1) & 1)
            value = extra->bits == 64 ? (double)(int64_t)part
                                      : (double)((int64_t)part - (INT64_C(1) << (extra->bits - 1)) * 2);
    }
    if (!extra->has_scale)
        return (value * field->multiplier + extra->addend) / field->divisor;
    double power = expected(data, len, extra->scale_at, MD_I16 | (extra->scale_format & MD_LOW_BYTE_FIRST));
    if (isnan(power) || fabs(power) > 22)
        return (double)NAN;
    double factor = 1;
    for (int i = 0; i < fabs(power); i++)
        factor *= 10;
    return power < 0 ? (value * field->multiplier + extra->addend) / (field->divisor * factor)
                     : (value * (field->multiplier * factor) + extra->addend) / field->divisor;
}

static int is_same(double a, double b)
{
    return isnan(a) ? isnan(b) : a == b;
}

static void check_rows(const uint8_t *head, const struct md_block *block,
                       const struct md_completion *completion)
{
    size_t room = head[1] % 12;
    struct md_columns rows = {.room = room};
    rows.time = malloc((room + 1) * sizeof *rows.time);
    rows.sent = malloc((room + 1) * sizeof *rows.sent);
    rows.uncertainty = malloc((room + 1) * sizeof *rows.uncertainty);
    rows.drive = malloc((room + 1) * sizeof *rows.drive);
    rows.reg = malloc((room + 1) * sizeof *rows.reg);
    rows.status = malloc((room + 1) * sizeof *rows.status);
    rows.value = malloc((room + 1) * sizeof *rows.value);
    rows.valid = malloc(room / 8 + 1);
    for (int round = 0; round < 4; round++) {
        size_t before = rows.rows;
        int added = md_columns_add(&rows, block, completion, 1000);
        must(added == (room - before >= (size_t)block->count ? block->count : 0) &&
             rows.rows == before + (size_t)added);
        uint64_t lacking = 0;
        for (size_t row = before; row < rows.rows; row++) {
            const struct md_field *field = &block->fields[row - before];
            const struct md_message *reply = &completion->reply;
            double value = field->extra
                               ? expected_with(reply->data, reply->data_len, field,
                                               &block->extra[field->extra - 1])
                               : expected(reply->data, reply->data_len, field->at, field->format) *
                                     field->multiplier / field->divisor;
            int is_value = completion->result >= 0 && !completion->reply.exception;
            must(rows.drive[row] == block->drive && rows.reg[row] == field->reg &&
                 rows.time[row] == rows.sent[row] + 1000);
            must((rows.valid[row / 8] >> row % 8 & 1) == (rows.status[row] == 0));
            if (completion->result < 0)
                must(rows.status[row] == -completion->result);
            else if (completion->reply.exception)
                must(rows.status[row] == 256 + completion->reply.exception);
            must(!is_value ||
                 is_same(rows.status[row] ? (double)NAN : rows.value[row], value));
            must(!is_value || rows.status[row] == 0 || rows.status[row] == -MD_BAD_LENGTH ||
                 rows.status[row] == MD_NO_VALUE);
            lacking += rows.status[row] == MD_NO_VALUE;
            must(rows.status[row] == 0 || (rows.value[row] == 0 && rows.uncertainty[row] == 0));
        }
        if (added && completion->result >= 0 && !completion->reply.exception)
            must(md_count_lacking(block, &completion->reply) == lacking);
    }
    free(rows.time), free(rows.sent), free(rows.uncertainty), free(rows.drive);
    free(rows.reg), free(rows.status), free(rows.value), free(rows.valid);
}

/* Check that md_spell() joins the names that the codes stand for. It must return -1 for an unknown code or a
 * full buffer. */
static void check_spelling(const uint8_t *head, const uint8_t *text, size_t len)
{
    int32_t offsets[5] = {0};
    uint16_t codes[8];
    size_t names = head[2] % 5, needed = 0, room = head[3], n = head[4] % 9;
    for (size_t i = 0; i < names; i++)
        offsets[i + 1] = offsets[i] + (int32_t)((len - (size_t)offsets[i]) * (head[5] >> 2 * i & 3) / 4);
    int is_named = 1;
    for (size_t i = 0; i < n; i++) {
        codes[i] = (uint16_t)(text[i % len] % 6);
        is_named &= codes[i] < names;
        needed += codes[i] < names ? (size_t)(offsets[codes[i] + 1] - offsets[codes[i]]) : 0;
    }
    int32_t *ends = malloc((n + 1) * sizeof *ends);
    uint8_t *out = malloc(room ? room : 1);
    int64_t used = md_spell(codes, n, text, offsets, names, ends, out, room);
    must(is_named && needed <= room ? used == (int64_t)needed : used == -1);
    for (size_t i = 0; i < n && used >= 0; i++)
        must(ends[i + 1] - ends[i] == offsets[codes[i] + 1] - offsets[codes[i]] &&
             memcmp(out + ends[i], text + offsets[codes[i]], (size_t)(ends[i + 1] - ends[i])) == 0);
    free(ends);
    free(out);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size <= HEADER + FIELDS * FIELD || size > MOST)
        return 0;
    struct md_field fields[FIELDS];
    struct md_extra extras[FIELDS] = {0};
    for (int i = 0; i < FIELDS; i++) {
        const uint8_t *from = data + HEADER + FIELD * i;
        fields[i] = (struct md_field){.at = (uint16_t)(from[0] << 8 | from[1]), .format = from[2],
                                      .reg = (uint16_t)(from[3] << 8 | from[4]),
                                      .extra = (uint16_t)(from[5] & 1 ? i + 1 : 0),
                                      .multiplier = 1, .divisor = 1 + from[5]};
        extras[i] = (struct md_extra){.addend = from[3], .low = from[4] % 64, .scale_at = from[1],
                                      .has_scale = from[3] & 1, .invalid_count = from[3] >> 1 & 3,
                                      .scale_format = MD_I16 | (from[3] & 8 ? MD_LOW_BYTE_FIRST : 0),
                                      .invalid = {{0xFF, from[3]}, {0xFFFF, from[5]}, {3, from[4] & 3}}};
        extras[i].bits = (uint8_t)(from[3] & 16 ? from[5] % (64 - extras[i].low) + 1 : 0);
    }
    const uint8_t *bytes = data + HEADER + FIELDS * FIELD;
    size_t len = size - HEADER - FIELDS * FIELD;
    uint8_t *exact = exact_copy(bytes, len);
    for (int wire = -1; wire <= 256; wire++) {
        if (wire > 0 && (wire & 0x3F) > MD_BCD32 + 1)
            continue; /* one unknown format is enough */
        for (size_t at = 0; at <= 8 * len + 1; at++)
            must(is_same(md_value(exact, len, at, wire), expected(exact, len, at, wire)));
    }
    for (int i = 0; i < FIELDS; i++)
        must(isnan(md_value(exact, len, SIZE_MAX - data[6 + i % 2], fields[i].format)));
    struct md_completion completion = {.result = data[0] & 0x80 ? -(1 + data[0] % 15) : 5, .begun_ns = 7,
                                       .sent_ns = data[7],
                                       .first_ns = data[7] + 3, .reply = {.data_len = (uint16_t)len}};
    completion.reply.exception = data[0] & 0x40 ? data[6] : 0;
    memcpy(completion.reply.data, bytes, len);
    check_rows(data,
               &(struct md_block){.fields = fields, .extra = extras, .may_lack = 1,
                                   .count = data[0] % 5 % (FIELDS + 1), .drive = data[5]},
                   &completion);
    check_spelling(data, exact, len);
    free(exact);
    return 0;
}

/* Return 0: an input has no frame to repair. */
int find_wire(uint8_t *data, size_t size, unsigned seed, struct wire *wire)
{
    (void)data, (void)size, (void)seed, (void)wire;
    return 0;
}
