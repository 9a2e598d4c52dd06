/* Hostile bytes for the parsers and the line.
 *
 *   clang -std=c11 -g -O1 -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all -Icsrc \
 *      tests/fuzz/fuzz_frame.c csrc/checksum.c csrc/frame.c csrc/reason.c csrc/tap.c csrc/line.c csrc/tally.c \
 *      -o fuzz_frame
 *   ./fuzz_frame -max_total_time=60 -max_len=1500 -len_control=0 CORPUS_DIRECTORY
 *
 * An input is a header (struct header) and what comes back from the line. Without the mutator below,
 * which repairs byte count and checksum, nothing would ever get past the checksum. */
#include "multidrop.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { HEADER = 10, MOST_RECEIVED = 4096 };

size_t LLVMFuzzerMutate(uint8_t *data, size_t size, size_t most);
size_t LLVMFuzzerCustomMutator(uint8_t *data, size_t size, size_t most, unsigned seed);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* framing, chunk, address, function, start, count, first two of the request's data */
static struct md_message request_of(const uint8_t *header)
{
    struct md_message request = {
        .address = header[2],
        .function = header[3],
        .start = (uint16_t)(header[4] << 8 | header[5]),
        .count = (uint16_t)(header[6] << 8 | header[7]),
        .data = {header[8], header[9]},
    };
    switch (request.function) {
    case 0x05: case 0x06: case 0x08: request.data_len = 2; break;
    case 0x0F: request.data_len = (uint16_t)((request.count + 7) / 8 % 251); break;
    case 0x10: request.data_len = (uint16_t)(2 * request.count % 251); break;
    default: break;
    }
    if (header[0] % 3 == MD_DELIXI)
        request.data_len = 4;
    return request;
}

#define must(truth) ((truth) ? (void)0 : (fprintf(stderr, "line %d: %s\n", __LINE__, #truth), abort()))

/* Whatever is accepted can be said, and is what was received; except for 89H, which stands for 88H. */
static void check_parsers(int framing, const uint8_t *bytes, size_t len, const struct md_message *request)
{
    struct md_message found;
    uint8_t built[MD_MOST_FRAME];
    int used = md_parse_request(framing, bytes, len, &found);
    must(used <= (int)len && (used <= 0 || found.data_len <= MD_MOST_DATA));
    int length = used > 0 ? md_build_request(framing, &found, built, sizeof built) : -1;
    must(length < 0 || (length == used && memcmp(built, bytes, (size_t)used) == 0));

    used = md_parse_reply(framing, bytes, len, request, &found);
    must(used <= (int)len && (used <= 0 || found.data_len <= MD_MOST_DATA));
    if (used <= 0)
        return;
    must(found.address == request->address && found.function == request->function);
    must(found.exception || (used == md_reply_length(framing, request) && found.start + found.count <= 0x1FFFE));
    length = md_build_reply(framing, &found, built, sizeof built);
    must(length < 0 || length == used);
    must(length < 0 || memcmp(built, bytes, (size_t)used) == 0 || found.exception ||
         (framing == MD_DELIXI && found.function == 3));
}

static int listens(struct md_line *line, int64_t now)
{
    int want = md_line_want(line, now);
    return want == MD_READ || want == MD_WAIT;
}

static uint32_t number(const uint8_t *at)
{
    return at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
}

/* A tap is told of what went over the line, byte for byte. */
static void check_tap(struct md_tap *tap, const struct md_line *line, const uint8_t *bytes, size_t len)
{
    enum { BYTES_AT = 28 };
    static struct md_wrapping bare[2 * MD_SIDES];
    for (size_t i = 0; i < sizeof bare / sizeof *bare; i++)
        bare[i].head = bare[i].tail = (const uint8_t *)"";
    static uint8_t packets[1 << 16], told[MD_MOST_FRAME + MOST_RECEIVED];
    size_t used = md_tap_take(tap, bare, 0, 0, packets, sizeof packets), have = 0;
    for (size_t at = 0; at < used; at += number(packets + at + 4)) {
        must(number(packets + at + number(packets + at + 4) - 4) == number(packets + at + 4));
        memcpy(told + have, packets + at + BYTES_AT, number(packets + at + 20));
        have += number(packets + at + 20);
    }
    must(tap->lost == 0 && tap->taken == tap->put && have == line->tx_len + len);
    must(memcmp(told, line->tx, line->tx_len) == 0 && memcmp(told + line->tx_len, bytes, len) == 0);
}

static void check_line(int framing, const uint8_t *bytes, size_t len, size_t chunk, const struct md_message *request)
{
    static struct md_line line;
    static struct md_completion done;
    struct md_drive drive = {.least_timeout_ns = 100, .most_timeout_ns = 1000};
    struct md_exchange exchange = {.framing = framing, .request = *request, .character_ns = 1, .drive = &drive};
    static uint8_t ring[1 << 15];
    static struct md_tap tap = {.ring = ring, .room = sizeof ring}; /* where in its ring it is, differs */
    md_line_init(&line, 1);
    line.tap = &tap;
    for (int round = 0; round < 2; round++) {
        md_line_begin(&line, &exchange, &done, 10 * (round + 1));
        int64_t now = 1000 * (round + 1);
        for (int wants = 0; wants < 3 && listens(&line, now); wants++)
            ;
        if (md_line_want(&line, now) == MD_DONE) {
            must(done.result == MD_BAD_REQUEST || (round == 1 && done.result == MD_LATE_ANSWER_DUE));
            return;
        }
        md_line_sent(&line, line.tx_len, now);
        size_t fed = 0;
        for (; fed < len && listens(&line, now); fed += len - fed < chunk ? len - fed : chunk) {
            size_t piece = len - fed < chunk ? len - fed : chunk;
            uint8_t *exact = malloc(piece);
            memcpy(exact, bytes + fed, piece);
            md_line_received(&line, exact, piece, now);
            free(exact);
            must(line.rx_from <= line.rx_len && line.rx_len <= sizeof line.rx);
            must(done.result || line.rx_len - line.rx_from < MD_MOST_FRAME);
        }
        for (int wants = 0; wants < 3 && md_line_want(&line, now) != MD_DONE; wants++)
            now = line.wake_ns;
        must(md_line_want(&line, now) == MD_DONE);
        check_tap(&tap, &line, bytes, fed);
        if (done.result > 0) {
            must(done.skipped + (uint32_t)done.result == fed && done.raw_len == done.result);
            struct md_message again;
            must(md_parse_reply(framing, done.raw, done.raw_len, request, &again) == done.result);
        } else
            must(request->address == 0 ? done.result == 0 : done.result != 0 && done.skipped == fed);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size < HEADER || size > MOST_RECEIVED)
        return 0;
    int framing = data[0] % 3;
    struct md_message request = request_of(data);
    size_t len = size - HEADER;
    uint8_t *exact = malloc(len ? len : 1);
    memcpy(exact, data + HEADER, len);
    check_parsers(framing, exact, len, &request);
    check_line(framing, exact, len, data[1] + 1u, &request);
    free(exact);
    return 0;
}

/* Make the bytes after the header the reply to its request: address, function, lengths, checksum. */
static size_t repair(uint8_t *data, size_t size, size_t most, unsigned seed)
{
    static const uint8_t digits[] = "0123456789ABCDEF", functions[] = {1, 2, 3, 4, 5, 6, 8, 0x0F, 0x10};
    int framing = data[0] % 3;
    if (seed & 2)
        data[3] = framing == MD_DELIXI ? (uint8_t)(2 + seed / 8 % 6) : functions[seed / 8 % sizeof functions];
    uint8_t body[262]; /* longer than any frame may be */
    size_t len = size - HEADER < 258 ? size - HEADER : 258, junk = seed / 128 % 4;
    if (framing == MD_DELIXI)
        len = 8;
    else if (len < 6)
        len = seed & 4 ? 3 : 6;
    memset(body, 0, sizeof body);
    memcpy(body, data + HEADER, len < size - HEADER ? len : size - HEADER);
    body[0] = data[2];
    body[1] = seed & 4 && len == 3 ? data[3] | 0x80 : data[3];
    if (framing != MD_DELIXI && data[3] >= 1 && data[3] <= 4 && len > 3) {
        len -= data[3] > 2 ? (len - 3) % 2 : 0;
        body[2] = (uint8_t)(len - 3);
        unsigned count = (unsigned)(len - 3) * 8 / (data[3] > 2 ? 16 : 1);
        data[6] = (uint8_t)(count >> 8);
        data[7] = (uint8_t)count;
    } else if (len > 3)
        memcpy(body + 2, data + 4, data[3] >= 0x0F ? 4 : 2);
    uint16_t crc = md_crc16(body, len);
    body[len] = framing == MD_RTU ? (uint8_t)crc : framing == MD_ASCII ? md_lrc(body, len) : md_sum(body, len);
    body[len + 1] = (uint8_t)(crc >> 8);
    size_t frame_len = framing == MD_RTU ? len + 2 : 2 * len + 5;
    if (HEADER + junk + frame_len > most)
        return size;
    uint8_t *at = data + HEADER + junk;
    if (framing == MD_RTU) {
        memcpy(at, body, len + 2);
        return HEADER + junk + frame_len;
    }
    *at++ = ':';
    for (size_t i = 0; i <= len; i++) {
        *at++ = digits[body[i] >> 4];
        *at++ = digits[body[i] & 15];
    }
    memcpy(at, "\r\n", 2);
    return HEADER + junk + frame_len;
}

size_t LLVMFuzzerCustomMutator(uint8_t *data, size_t size, size_t most, unsigned seed)
{
    size = LLVMFuzzerMutate(data, size, most);
    return size >= HEADER && seed & 1 ? repair(data, size, most, seed) : size;
}
