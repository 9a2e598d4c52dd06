/* Hostile replies and declarations for the makers of columns, and codes for their names.
 *
 * An input is a header (result, room, and so on), four fields of a block, and the reply's data. */
#include "fuzz.h"

#include <math.h>

enum { HEADER = 8, FIELD = 6, FIELDS = 4, MOST = HEADER + FIELDS * FIELD + MD_MOST_DATA };

/* What a value is, by the book: shifts and tables of another shape than the core's. */
static double expected(const uint8_t *data, size_t len, size_t at, int wire)
{
    static const char orders[][5] = {[MD_U32] = "0123", [MD_I32] = "0123", [MD_U32_SWAPPED] = "2301",
                                     [MD_I32_SWAPPED] = "2301", [MD_F32] = "0123", [MD_F32_SWAPPED] = "2301"};
    if (wire == MD_BIT)
        return at < 8 * len ? data[at / 8] / (1 << at % 8) % 2 : (double)NAN;
    if (wire < 0 || wire > MD_BIT)
        return (double)NAN;
    size_t bytes = wire == MD_U16 || wire == MD_I16 ? 2 : 4;
    if (at > len || 2 * at + bytes > len)
        return (double)NAN;
    const uint8_t *first = data + 2 * at;
    int64_t value = 0;
    for (size_t i = 0; i < bytes; i++)
        value = 256 * value + first[bytes == 4 && wire != MD_U32_EITHER ? (size_t)(orders[wire][i] - '0')
                                    : i];
    if (wire == MD_U32_EITHER)
        return (double)((value >> 16) | (value & 0xFFFF));
    if (wire == MD_F32 || wire == MD_F32_SWAPPED) {
        uint32_t bits = (uint32_t)value;
        float number;
        memcpy(&number, &bits, sizeof number);
        return (double)number;
    }
    int is_signed = wire == MD_I16 || wire == MD_I32 || wire == MD_I32_SWAPPED;
    int64_t range = bytes == 2 ? 0x10000 : 0x100000000;
    return (double)(is_signed && value >= range / 2 ? value - range : value);
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
        for (size_t row = before; row < rows.rows; row++) {
            const struct md_field *field = &block->fields[row - before];
            double value = expected(completion->reply.data, completion->reply.data_len, field->at,
                                    field->format);
            int is_value = completion->result >= 0 && !completion->reply.exception;
            must(rows.drive[row] == block->drive && rows.reg[row] == field->reg &&
                 rows.time[row] == rows.sent[row] + 1000);
            must((rows.valid[row / 8] >> row % 8 & 1) == (rows.status[row] == 0));
            if (completion->result < 0)
                must(rows.status[row] == -completion->result);
            else if (completion->reply.exception)
                must(rows.status[row] == 256 + completion->reply.exception);
            must(!is_value ||
                 is_same(rows.status[row] ? (double)NAN : rows.value[row],
                         value * field->multiplier / field->divisor));
            must(rows.status[row] == 0 || (rows.value[row] == 0 && rows.uncertainty[row] == 0));
        }
    }
    free(rows.time), free(rows.sent), free(rows.uncertainty), free(rows.drive);
    free(rows.reg), free(rows.status), free(rows.value), free(rows.valid);
}

/* The names of the codes, one after another; what has no name, or no room, is refused. */
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
    for (int i = 0; i < FIELDS; i++) {
        const uint8_t *from = data + HEADER + FIELD * i;
        fields[i] = (struct md_field){.at = (uint16_t)(from[0] << 8 | from[1]), .format = from[2],
                                      .reg = (uint16_t)(from[3] << 8 | from[4]),
                                      .multiplier = 1, .divisor = 1 + from[5]};
    }
    const uint8_t *bytes = data + HEADER + FIELDS * FIELD;
    size_t len = size - HEADER - FIELDS * FIELD;
    uint8_t *exact = exact_copy(bytes, len);
    for (int wire = -1; wire <= MD_BIT + 1; wire++)
        for (size_t at = 0; at <= 8 * len + 1; at++)
            must(is_same(md_value(exact, len, at, wire), expected(exact, len, at, wire)));
    for (int i = 0; i < FIELDS; i++)
        must(isnan(md_value(exact, len, SIZE_MAX - data[6 + i % 2], fields[i].format)));
    struct md_completion completion = {.result = data[0] & 0x80 ? -(1 + data[0] % 15) : 5, .begun_ns = 7,
                                       .sent_ns = data[7],
                                       .first_ns = data[7] + 3, .reply = {.data_len = (uint16_t)len}};
    completion.reply.exception = data[0] & 0x40 ? data[6] : 0;
    memcpy(completion.reply.data, bytes, len);
    check_rows(data,
               &(struct md_block){.fields = fields, .count = data[0] % 5 % (FIELDS + 1), .drive = data[5]},
                   &completion);
    check_spelling(data, exact, len);
    free(exact);
    return 0;
}

/* Replies' data have no checksum. */
int find_wire(uint8_t *data, size_t size, unsigned seed, struct wire *wire)
{
    (void)data, (void)size, (void)seed, (void)wire;
    return 0;
}
