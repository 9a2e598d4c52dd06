/* Test the C core with the frames that manuals print, and with hostile lengths, without a test framework.
 *
 *   cc -std=c11 -D_DEFAULT_SOURCE -g -O1 -fsanitize=address,undefined -fno-sanitize-recover=all \
 *      -Icsrc tests/c/test_core.c csrc/{body,frame,tap,line,reply,tcp,late,stats,columns}.c \
 *      -lm -o test_core
 *   ./test_core tests/data/frames.csv
 *
 * Without -fsanitize it also runs under valgrind: --error-exitcode=99 --leak-check=full. */
#include "checks.h"
#include "line.h"

/* ---- frames printed in manuals ---- */

struct frame {
    int framing, is_reply, result; /* result: the parser's return value for the whole frame */
    uint8_t bytes[MD_MOST_FRAME];
    size_t len;
};

static int parse(const struct frame *frame, const uint8_t *bytes, size_t len,
                 const struct md_message *request)
{
    struct md_message found;
    const uint8_t *edge = at_the_edge(bytes, len);
    return frame->is_reply ? md_parse_reply(frame->framing, edge, len, request, &found)
                           : md_parse_request(frame->framing, edge, len, &found);
}

/* Parse a frame in several forms: whole, byte by byte, followed by other bytes, and with each of its bits
 * inverted, one at a time. */
static void check_parse(const struct frame *frame, const struct md_message *request)
{
    uint8_t bytes[MD_MOST_FRAME + 3];
    memcpy(bytes, frame->bytes, frame->len);
    memset(bytes + frame->len, frame->bytes[0], 3);
    int refused = 0;
    for (size_t len = 0; len < frame->len; len++) {
        int used = parse(frame, bytes, len, request);
        CHECK(used == MD_INCOMPLETE || (used < 0 && used == frame->result));
        CHECK(used || !refused); /* once the parser has rejected the bytes, more bytes do not change that */
        refused = used;
    }
    for (size_t more = 0; more <= 3; more++)
        CHECK(parse(frame, bytes, frame->len + more, request) == frame->result);
    for (size_t bit = 0; bit < 8 * frame->len && frame->result > 0; bit++) {
        bytes[bit / 8] ^= (uint8_t)(1 << bit % 8);
        CHECK(parse(frame, bytes, frame->len, request) <= 0);
        bytes[bit / 8] ^= (uint8_t)(1 << bit % 8);
    }
}

static void send(struct md_line *line, const struct md_exchange *exchange, struct md_completion *completion)
{
    md_line_init(line, 0);
    md_line_begin(line, exchange, completion, 0);
    CHECK(md_line_want(line, exchange->silence_ns - 1) == MD_WAIT);
    CHECK(md_line_want(line, exchange->silence_ns) == MD_READ);
    CHECK(md_line_want(line, exchange->silence_ns) == MD_WRITE);
    md_line_sent(line, line->tx_len, exchange->silence_ns, exchange->silence_ns);
}

/* Check that a line finds the frame after junk, in pieces of `step` bytes, and counts the junk. */
static void check_line(const struct frame *frame, const struct md_message *request, const uint8_t *junk,
                       size_t junk_len, size_t step)
{
    static struct md_line line;
    static struct md_completion completion;
    struct md_history history = {0};
    /* `proofs` is NULL with a count above 0, to check that this exchange does not read the list */
    struct md_drive drive = {.least_timeout_ns = 1000000, .most_timeout_ns = 1000000, .history = &history,
                             .proofs = NULL, .proof_count = MD_MOST_PROOFS};
    struct md_exchange exchange = {.framing = frame->framing, .request = *request, .character_ns = 1000,
                                   .silence_ns = 4000, .drive = &drive};
    uint8_t bytes[MD_MOST_FRAME + 8];
    size_t len = junk_len + frame->len;
    memcpy(bytes, junk, junk_len);
    memcpy(bytes + junk_len, frame->bytes, frame->len);
    send(&line, &exchange, &completion);
    for (size_t at = 0; at < len; at += step) {
        size_t piece = len - at < step ? len - at : step;
        int want = md_line_want(&line, 10000);
        CHECK(want == MD_READ || want == MD_WAIT);
        md_line_received(&line, at_the_edge(bytes + at, piece), piece, 10000);
    }
    CHECK(md_line_want(&line, 10000) == MD_DONE);
    CHECK(completion.result == frame->result && completion.skipped == junk_len);
    CHECK(completion.raw_len == frame->len && memcmp(completion.raw, frame->bytes, frame->len) == 0);
}

static void check_behind_junk(const struct frame *frame, const struct md_message *request)
{
    static const uint8_t junk[] = {0x00, 0xFF, ':', 0x01, 0x55, ':', '0'};
    for (size_t junk_len = 0; junk_len <= sizeof junk; junk_len++)
        for (size_t step = 1; step <= 64; step *= 4)
            check_line(frame, request, junk, junk_len, step);
    check_line(frame, request, frame->bytes, 2, 1); /* here the junk is the frame's first two bytes */
}

/* Convert "01 03 ..." or ":0103...\r\n" (with escapes) to bytes. */
static size_t read_bytes(const char *text, uint8_t *bytes)
{
    size_t len = 0;
    if (*text != ':') {
        for (char *end; *text; text = end)
            bytes[len++] = (uint8_t)strtoul(text, &end, 16);
        return len;
    }
    for (; *text; text++)
        bytes[len++] = *text != '\\' ? (uint8_t)*text : *++text == 'r' ? '\r' : '\n';
    return len;
}

/* A reply in the file answers the last valid request before it. */
static void check_documents(const char *path)
{
    char text[512], model[32], framing[16], direction[16], bytes[256], verdict[32];
    struct md_message request = {0};
    FILE *file = fopen(path, "r");
    int rows = 0;
    if (!file || !fgets(text, sizeof text, file))
        exit(2);
    for (; fgets(text, sizeof text, file); rows++) {
        row = text;
        if (sscanf(text, "%31[^,],%15[^,],%15[^,],%255[^,],%31[^,]", model, framing, direction, bytes,
                   verdict) != 5)
            exit(2);
        struct frame frame = {.is_reply = strcmp(direction, "reply") == 0};
        frame.framing = strcmp(framing, "rtu") == 0 ? MD_RTU : strcmp(framing, "ascii") == 0 ? MD_ASCII
            : MD_DELIXI;
        frame.len = read_bytes(bytes, frame.bytes);
        frame.result = strcmp(verdict, "bad checksum") == 0 ? MD_BAD_CHECKSUM : (int)frame.len;
        if (strcmp(verdict, "bad content") == 0 && frame.is_reply && frame.bytes[1] == 0x04)
            frame.result = MD_BAD_LENGTH; /* the reply's byte count does not match the request */
        check_parse(&frame, &request);
        if (frame.is_reply && frame.result > 0)
            check_behind_junk(&frame, &request);
        if (frame.is_reply || frame.result < 0)
            continue;
        uint8_t built[MD_MOST_FRAME];
        CHECK(md_parse_request(frame.framing, frame.bytes, frame.len, &request) == (int)frame.len);
        CHECK(md_build_request(frame.framing, &request, built, sizeof built) == (int)frame.len);
        CHECK(memcmp(built, frame.bytes, frame.len) == 0);
        CHECK(md_build_request(frame.framing, &request, built, frame.len - 1) == MD_BAD_REQUEST);
        if (request.data_len && request.count == 0) { /* the reply repeats the written value */
            frame.is_reply = frame.framing != MD_DELIXI || request.function != 0x07;
            check_parse(&frame, &request);
        }
    }
    fclose(file);
    CHECK(rows == 49);
}

/* ---- bounds of fields ---- */

static const struct {
    const char *name;
    int framing, length; /* 0: MD_BAD_REQUEST */
    struct md_message message;
} requests[] = {
    {"125 registers", MD_RTU, 8, {.address = 1, .function = 3, .count = 125}},
    {"126 registers", MD_RTU, 0, {.address = 1, .function = 3, .count = 126}},
    {"125 input registers", MD_RTU, 8, {.address = 1, .function = 4, .count = 125}},
    {"126 input registers", MD_RTU, 0, {.address = 1, .function = 4, .count = 126}},
    {"no register", MD_RTU, 0, {.address = 1, .function = 4}},
    {"2000 bits", MD_ASCII, 17, {.address = 1, .function = 1, .count = 2000}},
    {"2000 inputs", MD_RTU, 8, {.address = 1, .function = 2, .count = 2000}},
    {"2001 bits", MD_RTU, 0, {.address = 1, .function = 2, .count = 2001}},
    {"to the last register", MD_RTU, 8, {.address = 1, .function = 3, .start = 0xFFFF, .count = 1}},
    {"past the last register", MD_RTU, 0, {.address = 1, .function = 3, .start = 0xFFFF, .count = 2}},
    {"a count that wraps around", MD_RTU, 0, {.address = 1, .function = 3, .start = 1, .count = 0xFFFF}},
    {"a read with data", MD_RTU, 0, {.address = 1, .function = 3, .count = 1, .data_len = 2}},
    {"a broadcast read", MD_RTU, 0, {.function = 3, .count = 1}},
    {"a broadcast read of coils", MD_RTU, 0, {.function = 1, .count = 1}},
    {"a broadcast read of inputs", MD_RTU, 0, {.function = 2, .count = 1}},
    {"a broadcast read of input registers", MD_RTU, 0, {.function = 4, .count = 1}},
    {"a broadcast write of words", MD_RTU, 11, {.function = 0x10, .count = 1, .data_len = 2}},
    {"a broadcast write of coils", MD_RTU, 10, {.function = 0x0F, .count = 1, .data_len = 1}},
    {"a broadcast coil", MD_RTU, 8, {.function = 5, .data_len = 2}},
    {"a broadcast write", MD_RTU, 8, {.function = 6, .data_len = 2}},
    {"a broadcast loopback", MD_RTU, 0, {.function = 8, .data_len = 2}},
    {"the last address", MD_RTU, 8, {.address = 247, .function = 6, .data_len = 2}},
    {"a reserved address", MD_RTU, 0, {.address = 248, .function = 6, .data_len = 2}},
    {"123 words", MD_RTU, 255, {.address = 1, .function = 0x10, .count = 123, .data_len = 246}},
    {"123 words as text", MD_ASCII, 511, {.address = 1, .function = 0x10, .count = 123, .data_len = 246}},
    {"124 words", MD_RTU, 0, {.address = 1, .function = 0x10, .count = 124, .data_len = 248}},
    {"a byte too few", MD_RTU, 0, {.address = 1, .function = 0x10, .count = 2, .data_len = 3}},
    {"a word too few", MD_RTU, 0, {.address = 1, .function = 0x10, .count = 2, .data_len = 2}},
    {"1968 coils", MD_RTU, 255, {.address = 1, .function = 0x0F, .count = 1968, .data_len = 246}},
    {"1969 coils", MD_RTU, 0, {.address = 1, .function = 0x0F, .count = 1969, .data_len = 247}},
    {"a coil that is on", MD_RTU, 8, {.address = 1, .function = 5, .data_len = 2, .data = {0xFF}}},
    {"a coil that is off", MD_RTU, 8, {.address = 1, .function = 5, .data_len = 2}},
    {"a coil between on and off", MD_RTU, 0, {.address = 1, .function = 5, .data_len = 2, .data = {0x01}}},
    {"a coil more than on", MD_RTU, 0, {.address = 1, .function = 5, .data_len = 2, .data = {0xFF, 0x01}}},
    {"more data than there is room for", MD_RTU, 0, {.address = 1, .function = 6, .data_len = 0xFFFF}},
    {"no function", MD_RTU, 0, {.address = 1, .count = 1}},
    {"a mask", MD_RTU, 10, {.address = 1, .function = 0x16, .start = 4, .data_len = 4}},
    {"half a mask", MD_RTU, 0, {.address = 1, .function = 0x16, .start = 4, .data_len = 2}},
    {"a broadcast mask", MD_RTU, 0, {.function = 0x16, .start = 4, .data_len = 4}},
    {"an event log", MD_RTU, 4, {.address = 1, .function = 0x0C}},
    {"a queue", MD_RTU, 6, {.address = 1, .function = 0x18, .start = 5}},
    {"a queue with data", MD_RTU, 0, {.address = 1, .function = 0x18, .data_len = 2}},
    {"a function that nobody here knows", MD_RTU, 0, {.address = 1, .function = 0x17, .count = 1}},
    {"an exception's function", MD_RTU, 0, {.address = 1, .function = 0x83, .count = 1}},
    {"a read over a network", MD_TCP, 12, {.address = 1, .function = 3, .count = 1}},
    {"123 words over a network", MD_TCP, 259, {.address = 1, .function = 0x10, .count = 123, .data_len = 246}},
    {"a run command", MD_DELIXI, 21, {.address = 1, .function = 2, .start = 1, .data_len = 4}},
    {"a broadcast run command", MD_DELIXI, 21, {.function = 2, .start = 1, .data_len = 4}},
    {"a broadcast parameter", MD_DELIXI, 0, {.function = 5, .start = 1, .data_len = 4}},
    {"a value of two bytes", MD_DELIXI, 0, {.address = 1, .function = 5, .start = 1, .data_len = 2}},
    {"what only the drive may say", MD_DELIXI, 0, {.address = 1, .function = 0xFF, .data_len = 4}},
}, replies[] = {
    {"125 registers", MD_RTU, 255, {.address = 1, .function = 3, .data_len = 250}},
    {"125 registers as text", MD_ASCII, 511, {.address = 1, .function = 3, .data_len = 250}},
    {"125 registers over a network", MD_TCP, 259, {.address = 1, .function = 3, .data_len = 250}},
    {"a byte more", MD_RTU, 0, {.address = 1, .function = 3, .data_len = 251}},
    {"half a register", MD_RTU, 0, {.address = 1, .function = 4, .data_len = 3}},
    {"nothing", MD_RTU, 0, {.address = 1, .function = 3}},
    {"a byte of bits", MD_RTU, 6, {.address = 1, .function = 1, .data_len = 1}},
    {"2000 inputs", MD_RTU, 255, {.address = 1, .function = 2, .data_len = 250}},
    {"an exception", MD_RTU, 5, {.address = 1, .function = 3, .exception = 2}},
    {"words written", MD_RTU, 8, {.address = 1, .function = 0x10, .count = 123}},
    {"too many words written", MD_RTU, 0, {.address = 1, .function = 0x10, .count = 124}},
    {"an answer to a broadcast", MD_RTU, 0, {.function = 6, .data_len = 2}},
    {"words written, and words", MD_RTU, 0, {.address = 1, .function = 0x10, .count = 1, .data_len = 2}},
    {"a value written", MD_RTU, 8, {.address = 1, .function = 6, .data_len = 2}},
    {"half a value written", MD_RTU, 0, {.address = 1, .function = 6, .data_len = 1}},
    {"two values written by one's function", MD_RTU, 0, {.address = 1, .function = 6, .data_len = 4}},
    {"a mask written", MD_RTU, 10, {.address = 1, .function = 0x16, .start = 4, .data_len = 4}},
    {"an empty queue", MD_RTU, 8, {.address = 1, .function = 0x18, .data_len = 4, .data = {0, 2}}},
    {"a queue of another length", MD_RTU, 0, {.address = 1, .function = 0x18, .data_len = 4}},
    {"no bytes of a server id", MD_RTU, 0, {.address = 1, .function = 0x11}},
    {"one byte of a server id", MD_RTU, 6, {.address = 1, .function = 0x11, .data_len = 1}},
    {"an identification without objects", MD_RTU, 10, {.address = 1, .function = 0x2B, .data_len = 6,
                                                            .data = {0x0E, 1, 1}}},
    {"an identification without its last object", MD_RTU, 0, {.address = 1, .function = 0x2B,
                                                            .data_len = 250,
                                                            .data = {0x0E, 1, 1, 0, 0, 2, 0, 242}}},
    {"an answer to what nobody here knows", MD_RTU, 0, {.address = 1, .function = 0x17, .data_len = 2}},
    {"an answer from a reserved address", MD_RTU, 0, {.address = 248, .function = 6, .data_len = 2}},
    {"a value", MD_DELIXI, 21, {.address = 1, .function = 7, .data_len = 4}},
    {"half a value", MD_DELIXI, 0, {.address = 1, .function = 7, .data_len = 2}},
    {"a value of no command", MD_DELIXI, 0, {.address = 1, .function = 1, .data_len = 4}},
    {"a value of a command too far", MD_DELIXI, 0, {.address = 1, .function = 8, .data_len = 4}},
    {"a refusal of an unknown command", MD_DELIXI, 21, {.address = 1, .function = 9, .exception = 0xF0}},
    {"a refusal that is none", MD_DELIXI, 0, {.address = 1, .function = 2, .exception = 0x02}},
};

static void check_builders(void)
{
    for (size_t i = 0; i < COUNT(requests) + COUNT(replies); i++) {
        int is_reply = i >= COUNT(requests);
        size_t at = is_reply ? i - COUNT(requests) : i;
        int framing = is_reply ? replies[at].framing : requests[at].framing;
        int length = is_reply ? replies[at].length : requests[at].length;
        const struct md_message *message = is_reply ? &replies[at].message : &requests[at].message;
        int (*build)(int, const struct md_message *, uint8_t *, size_t) = is_reply ? md_build_reply
            : md_build_request;
        row = is_reply ? replies[at].name : requests[at].name;
        for (size_t room = 0; room <= MD_MOST_FRAME; room++)
            CHECK(build(framing, message, page_end() - room, room) ==
                  (length && room >= (size_t)length ? length : MD_BAD_REQUEST));
    }
}

/* ---- after which byte the parser knows the result ---- */

static const struct {
    const char *name, *bytes; /* the result is known at the last byte, not earlier */
    int framing, result;
    struct md_message request; /* if empty, `bytes` are a request, otherwise a reply to it */
} verdicts[] = {
    {"no function", "01 42", MD_RTU, MD_BAD_FUNCTION, {0}},
    {"no function, as text", ":0142", MD_ASCII, MD_BAD_FUNCTION, {0}},
    {"the code after the last known function", "01 2C", MD_RTU, MD_BAD_FUNCTION, {0}},
    {"an exception's function", "01 83", MD_RTU, MD_BAD_FUNCTION, {0}},
    {"what only the drive may say", ":01F0", MD_DELIXI, MD_BAD_FUNCTION, {0}},
    {"a word more than may be written", "01 10 00 00 00 7C F8", MD_RTU, MD_BAD_LENGTH, {0}},
    {"a byte less than the words written", "01 10 00 00 00 02 03", MD_RTU, MD_BAD_LENGTH, {0}},
    {"a byte less, as text", ":01100000000203", MD_ASCII, MD_BAD_LENGTH, {0}},
    {"no colon", "01", MD_ASCII, MD_NO_START, {0}},
    {"what comes before 0", ":0/", MD_ASCII, MD_BAD_CHARACTER, {0}},
    {"what comes after 9", ":0:", MD_ASCII, MD_BAD_CHARACTER, {0}},
    {"what comes before A", ":0@", MD_ASCII, MD_BAD_CHARACTER, {0}},
    {"what comes after F", ":0G", MD_ASCII, MD_BAD_CHARACTER, {0}},
    {"what comes after F, first", ":G0", MD_ASCII, MD_BAD_CHARACTER, {0}},
    {"no digit in the checksum", ":0106001012349g", MD_ASCII, MD_BAD_CHARACTER, {0}},
    {"no carriage return", ":010600101234A3\\n", MD_ASCII, MD_BAD_CHARACTER, {0}},
    {"no line feed", ":010600101234A3\\r\\r", MD_ASCII, MD_BAD_CHARACTER, {0}},
    {"another protocol", "00 01 00 01", MD_TCP, MD_NO_START, {0}},
    {"another protocol, by its first byte", "00 01 01 00", MD_TCP, MD_NO_START, {0}},
    {"a head without a function", "00 01 00 00 00 01", MD_TCP, MD_NO_START, {0}},
    {"a head with a byte too much", "00 01 00 00 00 FF", MD_TCP, MD_NO_START, {0}},
    {"the longest head", "00 01 00 00 00 FE", MD_TCP, MD_INCOMPLETE, {0}},
    {"no function, over a network", "00 01 00 00 00 06 01 42", MD_TCP, MD_BAD_FUNCTION, {0}},
    {"a head that is shorter than its read", "00 01 00 00 00 05 01 03", MD_TCP, MD_BAD_LENGTH, {0}},
    {"a head that is longer than its read", "00 01 00 00 00 07 01 03", MD_TCP, MD_BAD_LENGTH, {0}},
    {"a head that ends before the count", "00 01 00 00 00 02 01 10", MD_TCP, MD_BAD_LENGTH, {0}},
    {"a read over a network", "00 01 00 00 00 06 01 03 00 00 00 01", MD_TCP, 12, {0}},
    {"a request of another MEI type", "01 2B 0D", MD_RTU, MD_BAD_FUNCTION, {0}},
    {"a request of a queue", "00 01 00 00 00 04 01 18 04 DE", MD_TCP, 10, {0}},
    {"a status over a network", "00 01 00 00 00 03 01 07 6D", MD_TCP, 9, {.address = 1, .function = 7}},
    {"an identification without objects", "00 01 00 00 00 08 01 2B 0E 01 01 00 00 00", MD_TCP, 14,
     {.address = 1, .function = 0x2B, .data_len = 3, .data = {0x0E, 1}}},
    {"an answer of another protocol", "00 01 00 01", MD_TCP, MD_NO_START, {.address = 1, .function = 3,
                                                            .count = 1}},
    {"an exception with a short head", "00 01 00 00 00 01 01 83 02", MD_TCP, 9, {.address = 1,
                                                            .function = 3, .count = 1}},
    {"an exception with a long head", "00 01 00 00 01 03 01 83 02", MD_TCP, 9, {.address = 1,
                                                            .function = 3, .count = 1}},
    {"another drive", "02", MD_RTU, MD_BAD_ADDRESS, {.address = 1, .function = 3, .count = 2}},
    {"another drive, as text", ":02", MD_DELIXI, MD_BAD_ADDRESS, {.address = 1, .function = 7,
                                                            .data_len = 4}},
    {"an answer to a broadcast", "00", MD_RTU, MD_BAD_ADDRESS, {.function = 6, .data_len = 2}},
    {"another function", "01 04", MD_RTU, MD_BAD_FUNCTION, {.address = 1, .function = 3, .count = 2}},
    {"another function's exception", "01 84", MD_RTU, MD_BAD_FUNCTION, {.address = 1, .function = 3,
                                                            .count = 2}},
    {"an exception without a code", "01 83 00", MD_RTU, MD_BAD_FUNCTION, {.address = 1, .function = 3,
                                                            .count = 2}},
    {"another byte count", "01 03 02", MD_RTU, MD_BAD_LENGTH, {.address = 1, .function = 3, .count = 2}},
    {"125 registers begin", "01 03 FA", MD_RTU, MD_INCOMPLETE, {.address = 1, .function = 3, .count = 125}},
    {"2000 bits begin", "01 01 FA", MD_RTU, MD_INCOMPLETE, {.address = 1, .function = 1, .count = 2000}},
    {"an answer to no function", "01 42", MD_RTU, MD_BAD_FUNCTION, {.address = 1, .function = 0x42}},
    {"an event log", "01 0C 02 00 00 BB 50", MD_RTU, 7, {.address = 1, .function = 0x0C}},
    {"a queue over a network", "00 01 00 00 00 0A 01 18 00 06 00 02 01 B8 12 84", MD_TCP, 16,
     {.address = 1, .function = 0x18, .start = 0x04DE}},
    {"the longest queue", "01 18 00 F8", MD_RTU, MD_INCOMPLETE, {.address = 1, .function = 0x18}},
    {"a queue that is too long", "01 18 00 F9", MD_RTU, MD_BAD_LENGTH, {.address = 1, .function = 0x18}},
    {"no bytes of a server id", "01 11 00", MD_RTU, MD_BAD_LENGTH, {.address = 1, .function = 0x11}},
    {"a server id of one byte", "01 11 01", MD_RTU, MD_INCOMPLETE, {.address = 1, .function = 0x11}},
    {"the longest server id", "01 11 FA", MD_RTU, MD_INCOMPLETE, {.address = 1, .function = 0x11}},
    {"too many of them", "01 11 FB", MD_RTU, MD_BAD_LENGTH, {.address = 1, .function = 0x11}},
    {"another MEI type", "01 2B 0D", MD_RTU, MD_BAD_FUNCTION, {.address = 1, .function = 0x2B}},
    {"a long identification", "01 2B 0E 01 01 00 00 01 00 F2", MD_RTU, MD_INCOMPLETE, {.address = 1,
                                                            .function = 0x2B}},
    {"one that is too long", "01 2B 0E 01 01 00 00 01 00 F3", MD_RTU, MD_BAD_LENGTH, {.address = 1,
                                                            .function = 0x2B}},
    {"another command", ":0106", MD_DELIXI, MD_BAD_FUNCTION, {.address = 1, .function = 7, .data_len = 4}},
    {"no state", ":010300000000000004\\r\\n", MD_DELIXI, MD_BAD_ECHO, {.address = 1, .function = 3,
                                                            .data_len = 4}},
    {"a state", ":010300010000000005\\r\\n", MD_DELIXI, 21, {.address = 1, .function = 3, .data_len = 4}},
    {"a state of two bytes", ":010301000000000005\\r\\n", MD_DELIXI, 21, {.address = 1, .function = 3,
                                                            .data_len = 4}},
    {"a refusal below the refusals", ":01FB", MD_DELIXI, MD_BAD_FUNCTION, {.address = 1, .function = 7,
                                                            .data_len = 4}},
};

static void check_verdicts(void)
{
    for (size_t i = 0; i < COUNT(verdicts); i++) {
        struct frame frame = {.framing = verdicts[i].framing, .is_reply = verdicts[i].request.function != 0};
        row = verdicts[i].name;
        frame.len = read_bytes(verdicts[i].bytes, frame.bytes);
        for (size_t len = 0; len < frame.len; len++)
            CHECK(parse(&frame, frame.bytes, len, &verdicts[i].request) == MD_INCOMPLETE);
        CHECK(parse(&frame, frame.bytes, frame.len, &verdicts[i].request) == verdicts[i].result);
        if (frame.is_reply)
            CHECK(verdicts[i].result <= md_longest_reply(frame.framing, &verdicts[i].request));
    }
}

/* ---- which of several faults is reported ---- */

static const struct {
    const char *name, *bytes; /* the most specific fault is the reason, or else the first */
    int framing, reason;
    struct md_message request;
} reasons[] = {
    {"no byte", "", MD_RTU, MD_NO_REPLY, {.address = 1, .function = 3, .count = 2}},
    {"no start", "30", MD_ASCII, MD_NO_START, {.address = 1, .function = 3, .count = 2}},
    {"no start, another drive", "30 3A 30 32", MD_ASCII, MD_BAD_ADDRESS, {.address = 1, .function = 3,
                                                            .count = 2}},
    {"another function, another length", ":0104:010302", MD_ASCII, MD_BAD_LENGTH, {.address = 1,
                                                            .function = 3, .count = 2}},
    {"another length, no digit", ":010302:010304G0", MD_ASCII, MD_BAD_CHARACTER, {.address = 1,
                                                            .function = 3, .count = 2}},
    {"no digit, half a reply", ":010304G0:010304", MD_ASCII, MD_CUT_SHORT, {.address = 1, .function = 3,
                                                            .count = 2}},
    {"half a reply, another checksum", "01 03 04 01 83 02 00 00", MD_RTU, MD_BAD_CHECKSUM,
     {.address = 1, .function = 3, .count = 2}},
    {"another checksum, another value", ":010600101234A4\\r\\n:010600101235A2\\r\\n", MD_ASCII, MD_BAD_ECHO,
     {.address = 1, .function = 6, .start = 0x10, .data_len = 2, .data = {0x12, 0x34}}},
    {"another drive, another function", ":02:0104", MD_ASCII, MD_BAD_ADDRESS, {.address = 1,
                                                            .function = 3, .count = 2}},
    {"another function, another drive", ":0104:02", MD_ASCII, MD_BAD_FUNCTION, {.address = 1,
                                                            .function = 3, .count = 2}},
    {"another drive twice, half a reply", "00 01 00 00 00 03 02 83 02 00 02 00 00 00 03 02 83 02 00 03 00",
     MD_TCP, MD_CUT_SHORT, {.address = 1, .function = 3, .count = 2}},
    {"only a good reply", "00 01 00 00 00 03 01 83 02", MD_TCP, MD_INCOMPLETE, {.address = 1,
                                                            .function = 3, .count = 2}},
    {"no path to the drive", "00 01 00 00 00 03 01 83 0A", MD_TCP, MD_NO_REPLY, {.address = 1,
                                                            .function = 3, .count = 2}},
};

static void check_reasons(void)
{
    for (size_t i = 0; i < COUNT(reasons); i++) {
        uint8_t bytes[MD_MOST_FRAME];
        size_t len = read_bytes(reasons[i].bytes, bytes);
        row = reasons[i].name;
        CHECK(md_reason(reasons[i].framing, &reasons[i].request, at_the_edge(bytes, len), len) ==
              reasons[i].reason);
    }
}

/* For a request with an impossible count, parsing a reply must not write beyond the message's data. */
static void check_impossible_counts(void)
{
    static const uint8_t functions[] = {1, 2, 3, 4, 5, 6, 7, 8, 0x0C, 0x0F, 0x10, 0x11, 0x16, 0x17, 0x18, 0x2B, 0x83};
    uint8_t reply[257] = {1};
    struct md_message found;
    row = "impossible count";
    for (size_t i = 0; i < sizeof functions; i++)
        for (unsigned count = 0; count < 2100; count++)
            for (unsigned bytes = 248; bytes < 256; bytes++) {
                struct md_message request = {.address = 1, .function = functions[i],
                                             .count = (uint16_t)count};
                size_t len = 3 + bytes < 255 ? 3 + bytes : 255;
                reply[1] = functions[i];
                reply[2] = (uint8_t)bytes;
                uint16_t crc = md_crc16(reply, len);
                reply[len] = (uint8_t)crc;
                reply[len + 1] = (uint8_t)(crc >> 8);
                int used = md_parse_reply(MD_RTU, at_the_edge(reply, len + 2), len + 2, &request, &found);
                CHECK(used <= 0 || (used <= 255 && found.data_len <= MD_MOST_DATA));
            }
}

int main(int argc, char **argv)
{
    if (argc != 2) {
        fprintf(stderr, "usage: %s frames.csv\n", argv[0]);
        return 2;
    }
    check_documents(argv[1]);
    check_builders();
    check_verdicts();
    check_reasons();
    check_impossible_counts();
    return end_of_checks();
}
