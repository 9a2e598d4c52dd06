/* Test columns, names and packets of the C core, without a test framework; built and run like test_core.c. */
#include "checks.h"
#include "internal.h"

#include <math.h>

static const struct {
    const char *name;
    uint8_t data[8];
    size_t len, at;
    int format;
    double value;
} values[] = {
    {"unsigned", {0xFF, 0xFE}, 2, 0, MD_U16, 65534},
    {"signed", {0xFF, 0xFE}, 2, 0, MD_I16, -2},
    {"second word", {0, 0, 0x13, 0x88}, 4, 1, MD_U16, 5000},
    {"unsigned long", {0xFF, 0xFF, 0xFF, 0xFE}, 4, 0, MD_U32, 4294967294.0},
    {"signed long", {0xFF, 0xFF, 0xFF, 0xFE}, 4, 0, MD_I32, -2},
    {"low word first", {0x00, 0x01, 0x00, 0x02}, 4, 0, MD_U32 | MD_LOW_WORD_FIRST, 131073},
    {"signed, low word first", {0xFF, 0xFE, 0xFF, 0xFF}, 4, 0, MD_I32 | MD_LOW_WORD_FIRST, -2},
    {"either word", {0x00, 0x00, 0x00, 0x02}, 4, 0, MD_U32_EITHER, 2},
    {"the other word", {0x00, 0x02, 0x00, 0x00}, 4, 0, MD_U32_EITHER, 2},
    {"half float", {0x52, 0x40}, 2, 0, MD_F16, 50},
    {"float", {0x42, 0x48, 0x00, 0x00}, 4, 0, MD_F32, 50},
    {"float, low word first", {0x00, 0x00, 0x42, 0x48}, 4, 0, MD_F32 | MD_LOW_WORD_FIRST, 50},
    {"float, low byte first", {0x48, 0x42, 0x00, 0x00}, 4, 0, MD_F32 | MD_LOW_BYTE_FIRST, 50},
    {"float, the wrong way round", {0x00, 0x00, 0x48, 0x42}, 4, 0,
     MD_F32 | MD_LOW_WORD_FIRST | MD_LOW_BYTE_FIRST, 50},
    {"low byte first", {0x34, 0x12}, 2, 0, MD_U16 | MD_LOW_BYTE_FIRST, 0x1234},
    {"a signed byte", {0x7F, 0xFE}, 2, 0, MD_I8, -2},
    {"the other byte", {0xFE, 0x7F}, 2, 0, MD_I8 | MD_LOW_BYTE_FIRST, -2},
    {"unsigned, 64 bit", {0, 0x20, 0, 0, 0, 0, 0, 0}, 8, 0, MD_U64, 9007199254740992.0},
    {"signed, 64 bit", {0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFE}, 8, 0, MD_I64, -2},
    {"64 bit, low word first", {0, 4, 0, 3, 0, 2, 0, 1}, 8, 0, MD_U64 | MD_LOW_WORD_FIRST, 281483566841860.0},
    {"double", {0xC0, 0x49, 0, 0, 0, 0, 0, 0}, 8, 0, MD_F64, -50},
    {"decimal", {0x12, 0x34}, 2, 0, MD_BCD16, 1234},
    {"long decimal", {0x98, 0x76, 0x54, 0x32}, 4, 0, MD_BCD32, 98765432},
    {"no decimal", {0x12, 0x3A}, 2, 0, MD_BCD16, NAN},
    {"half a double", {0, 0, 0, 0, 0, 0, 0}, 7, 0, MD_F64, NAN},
    {"first bit", {0x01}, 1, 0, MD_BIT, 1},
    {"last bit", {0x00, 0x80}, 2, 15, MD_BIT, 1},
    {"a bit too far", {0xFF}, 1, 8, MD_BIT, NAN},
    {"half a word", {0xFF}, 1, 0, MD_U16, NAN},
    {"a word too far", {0xFF, 0xFF}, 2, 1, MD_U16, NAN},
    {"half a long", {0xFF, 0xFF}, 2, 0, MD_U32, NAN},
    {"so far that it wraps around", {0xFF, 0xFF}, 2, SIZE_MAX / 2 + 1, MD_U16, NAN},
    {"the last bit there is", {0xFF}, 1, SIZE_MAX, MD_BIT, NAN},
    {"no such wire", {0xFF, 0xFF}, 2, 0, MD_BCD32 + 1, NAN},
    {"a bit has no order", {0xFF, 0xFF}, 2, 0, MD_BIT | MD_LOW_BYTE_FIRST, NAN},
    {"less than no wire", {0xFF, 0xFF}, 2, 0, -1, NAN},
};

static void check_values(void)
{
    for (size_t i = 0; i < COUNT(values); i++) {
        row = values[i].name;
        double value = md_value(at_the_edge(values[i].data, values[i].len), values[i].len, values[i].at,
                                values[i].format);
        CHECK(isnan(values[i].value) ? isnan(value) : value == values[i].value);
    }
}

static void check_columns(void)
{
    enum { ROOM = 3 };
    int64_t time[ROOM], sent[ROOM], uncertainty[ROOM];
    uint16_t drive[ROOM], reg[ROOM], status[ROOM];
    double value[ROOM];
    uint8_t *valid = page_end() - 1;
    struct md_columns columns = {time, sent, uncertainty, drive, reg, status, value, valid, 0, ROOM};
    const struct md_field fields[] = {{0, MD_U16, 8, 0, 1, 10}, {1, MD_U16, 9, 0, 1, 1}};
    struct md_completion completion = {
        .result = 7, .sent_ns = 100, .first_ns = 130, .reply = {.data_len = 2, .data = {0, 3}}};
    row = "columns";
    *valid = 0xFF;
    CHECK(md_columns_add(&columns, &(struct md_block){.fields = fields, .count = 2, .drive = 7}, &completion,
                         1000) == 2);
    CHECK(time[0] == 1100 && sent[0] == 100 && uncertainty[0] == 30 && drive[0] == 7 && reg[1] == 9);
    CHECK(status[0] == 0 && value[0] == (double)0.3 && status[1] == -MD_BAD_LENGTH && value[1] == 0);
    CHECK((*valid & 3) == 1);
    CHECK(md_columns_add(&columns, &(struct md_block){.fields = fields, .count = 2, .drive = 7}, &completion,
                         1000) == 0 && columns.rows == 2);
    completion = (struct md_completion){.result = MD_LINE_LOST, .begun_ns = 90};
    CHECK(md_columns_add(&columns, &(struct md_block){.fields = fields, .count = 1, .drive = 7}, &completion,
                         1000) == 1);
    CHECK(sent[2] == 90 && status[2] == -MD_LINE_LOST && (*valid & 7) == 1);
    CHECK(md_columns_add(&columns, &(struct md_block){.fields = fields, .count = 1, .drive = 7}, &completion,
                         1000) == 0 && columns.rows == ROOM);
}

static void check_spelling(void)
{
    static const uint16_t codes[] = {1, 0, 2, 1};
    static const uint8_t names[] = "pumpfan"; /* "pump", "fan", "" */
    static const int32_t offsets[] = {0, 4, 7, 7};
    enum { NAMES = 3 };
    int32_t ends[5] = {9, 9, 9, 9, 9};
    row = "spelling";
    CHECK(md_spell(codes, 4, names, offsets, NAMES, ends, page_end() - 10, 10) == 10);
    CHECK(memcmp(page_end() - 10, "fanpumpfan", 10) == 0);
    CHECK(ends[0] == 0 && ends[1] == 3 && ends[2] == 7 && ends[3] == 7 && ends[4] == 10);
    for (size_t room = 0; room < 10; room++)
        CHECK(md_spell(codes, 4, names, offsets, NAMES, ends, page_end() - room, room) == -1);
    CHECK(md_spell(codes, 0, names, offsets, NAMES, ends, page_end(), 0) == 0 && ends[0] == 0);
    CHECK(md_spell(codes, 4, names, offsets, NAMES - 1, ends, page_end() - 10, 10) == -1);
}

/* Check that packets match the pcapng draft, even if they wrap around the ring's end, and that lost bytes are
 * counted. */
static void check_tap(void)
{
    enum { ROOM = 64, LEN = 5, SIZE = 28 + 8 + 4 + 4 }; /* a packet: 28 + 8 (head and bytes) + 4 (tail) + 4 */
    static const uint8_t said[] = {'a', 'b', 'c', 'd', 'e'};
    static const uint8_t packet[SIZE] = {
        6, 0, 0, 0, SIZE, 0, 0, 0, 7, 0, 0, 0, 1, 0, 0, 0, 105, 0, 0, 0, 8, 0, 0, 0, 8, 0, 0, 0,
        'H', 'H', 'H', 'a', 'b', 'c', 'd', 'e', 'T', 'T', 'T', 'T', SIZE, 0, 0, 0,
    };
    static const struct md_wrapping wrappings[2 * MD_SIDES] = {
        [2 * MD_ANSWERING] = {.head = (const uint8_t *)"HHH", .head_len = 3, .tail = (const uint8_t *)"TTTT",
                              .tail_len = 4},
    };
    uint8_t ring[ROOM];
    struct md_tap tap = {.ring = ring, .room = ROOM};
    row = "tap";
    for (int round = 0; round < 100; round++) {
        for (int n = 0; n < 4; n++) /* a packet takes 21 bytes of the ring, so three fit */
            md_tap_put(&tap, MD_ANSWERING, INT64_C(0x100000000), said, LEN);
        CHECK(tap.lost == (uint64_t)LEN * (uint64_t)(round + 1));
        for (int n = 0; n < 3; n++) {
            uint8_t *out = page_end() - SIZE;
            CHECK(md_tap_take(&tap, wrappings, 7, 105, page_end() - SIZE + 1, SIZE - 1) == 0);
            CHECK(md_tap_take(&tap, wrappings, 7, 105, out, SIZE) == SIZE && memcmp(out, packet, SIZE) == 0);
        }
        CHECK(md_tap_take(&tap, wrappings, 7, 105, page_end() - SIZE, SIZE) == 0);
    }
    CHECK(md_packet_length(wrappings, MD_ANSWERING, 'a', LEN) == SIZE);
    md_put_packet(wrappings, 7, MD_ANSWERING, INT64_C(0x100000069), said, LEN, page_end() - SIZE);
    CHECK(memcmp(page_end() - SIZE, packet, SIZE) == 0);
}

int main(void)
{
    check_values();
    check_columns();
    check_spelling();
    check_tap();
    return end_of_checks();
}
