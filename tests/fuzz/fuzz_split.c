/* Hostile bytes, as overheard on a line and as a capture file.
 *
 *   clang -std=c11 -g -O1 -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all -Icsrc \
 *      tests/fuzz/fuzz_split.c csrc/checksum.c csrc/frame.c csrc/reason.c csrc/columns.c csrc/heard.c csrc/split.c \
 *      csrc/decode.c csrc/unpack.c -lm -o fuzz_split
 *   ./fuzz_split -max_total_time=60 -max_len=2048 -len_control=0 CORPUS_DIRECTORY
 *
 * An input is pieces: a byte with its length (0 to 63), side and pause, then its bytes. The mutator
 * appends frames with good checksums. */
#include "multidrop.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MOST = 8192, ROWS = 512, PLACES = 16 };

size_t LLVMFuzzerMutate(uint8_t *data, size_t size, size_t most);
size_t LLVMFuzzerCustomMutator(uint8_t *data, size_t size, size_t most, unsigned seed);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define must(truth) ((truth) ? (void)0 : (fprintf(stderr, "line %d: %s\n", __LINE__, #truth), abort()))

struct ear {
    struct md_heard heard;
    struct md_splitter splitter;
    size_t passed; /* bytes told so far, of all that was heard */
};

static void open_ear(struct ear *ear, size_t room)
{
    *ear = (struct ear){.heard = {.room = room, .most = room}};
    ear->heard.bytes = malloc(room);
    ear->heard.pieces = malloc(room * sizeof *ear->heard.pieces);
}

static void close_ear(struct ear *ear)
{
    free(ear->heard.bytes);
    free(ear->heard.pieces);
}

/* Spans follow each other without gaps, and frames are what they are said to be. */
static int next(struct ear *ear, struct md_span *span)
{
    memset(span, 0xAA, sizeof *span);
    size_t at = ear->splitter.at;
    if (!md_split(&ear->splitter, &ear->heard, span)) {
        must(ear->splitter.at == at && ear->heard.len - at <= MD_MOST_FRAME);
        must(!ear->heard.is_all || at == ear->heard.len);
        return 0;
    }
    must(span->len > 0 && span->at == at && ear->splitter.at == at + span->len && at + span->len <= ear->heard.len);
    ear->passed += span->len;
    if (span->kind == MD_REQUEST || span->kind == MD_EITHER) {
        struct md_message again;
        must(md_parse_request(span->framing, ear->heard.bytes + at, span->len, &again) == (int)span->len);
        must(ear->splitter.request.address == again.address && ear->splitter.framing == span->framing);
    }
    if (span->kind == MD_REPLY)
        must(span->message.address == ear->splitter.request.address && !ear->splitter.awaited);
    return 1;
}

/* The next frame and where it begins in all that was heard; junk is passed over. */
static int next_frame(struct ear *ear, struct md_span *span, size_t *at)
{
    while (next(ear, span))
        if (span->kind != MD_JUNK) {
            *at = ear->passed - span->len;
            return 1;
        }
    return 0;
}

static struct md_piece piece_of(const uint8_t *data, size_t left, size_t *len)
{
    *len = data[0] & 63;
    if (*len > left - 1)
        *len = left - 1;
    static const uint8_t sides[] = {MD_EITHER_SIDE, MD_EITHER_SIDE, MD_NOISE, MD_ASKING};
    struct md_piece piece = {.side = sides[data[0] >> 6], .is_after_pause = (data[0] >> 6) & 1};
    return piece;
}

/* However much is forgotten on the way, the frames are those that are found when all is there. */
static void check_split(const uint8_t *data, size_t size)
{
    struct ear whole, parts;
    open_ear(&whole, size + 1);
    open_ear(&parts, size + 1);
    size_t total = 0, len, whole_at = 0, part_at = 0;
    for (size_t at = 0; at < size; at += 1 + len) {
        struct md_piece piece = piece_of(data + at, size - at, &len);
        if (len)
            must(md_hear(&whole.heard, data + at + 1, len, piece));
        total += len;
    }
    whole.heard.is_all = 1;
    struct md_span expected, found;
    for (size_t at = 0; at < size; at += 1 + len) {
        struct md_piece piece = piece_of(data + at, size - at, &len);
        if (len)
            must(md_hear(&parts.heard, data + at + 1, len, piece));
        parts.heard.is_all = at + 1 + len >= size;
        while (next_frame(&parts, &found, &part_at)) {
            must(next_frame(&whole, &expected, &whole_at));
            must(part_at == whole_at && found.len == expected.len && found.kind == expected.kind);
        }
        md_forget(&parts.heard, &parts.splitter);
        must(parts.splitter.at == 0 && parts.heard.len <= MD_MOST_FRAME);
    }
    must(!next_frame(&whole, &expected, &whole_at));
    must(whole.passed == total && parts.passed == total);
    close_ear(&whole);
    close_ear(&parts);
}

static struct md_columns *columns(void)
{
    static int64_t time[ROWS], sent[ROWS], uncertainty[ROWS];
    static uint16_t drive[ROWS], reg[ROWS], status[ROWS];
    static double value[ROWS];
    static uint8_t valid[ROWS / 8];
    static struct md_columns columns = {.time = time, .sent = sent, .uncertainty = uncertainty, .drive = drive,
                                        .reg = reg, .status = status, .value = value, .valid = valid, .room = ROWS};
    columns.rows = 0;
    return &columns;
}

static void check_decode(struct md_decoder *decoder, const struct md_heard *heard)
{
    static const struct md_field fields[] = {{.at = 0, .multiplier = 1, .divisor = 1},
                                             {.at = 1, .wire = MD_U32, .multiplier = 1, .divisor = 1}};
    static const struct md_block block = {.fields = fields, .count = 2};
    struct md_columns *rows = columns();
    for (int state; (state = md_decode(decoder, heard, rows)) != MD_ALL_DECODED;) {
        if (state == MD_NO_ROOM) {
            must(ROWS - rows->rows < 2);
            rows->rows = 0;
        } else if (!md_know(decoder, decoder->span.framing, &decoder->span.message,
                            decoder->span.message.address ? &block : NULL)) {
            memset(decoder->known, 0, PLACES * sizeof *decoder->known);
            decoder->taken = 0;
        }
    }
    must(decoder->exchanges <= decoder->frames && decoder->junk <= MOST);
}

static void check_unpack(const uint8_t *data, size_t size, int is_pcapng)
{
    struct ear ear;
    open_ear(&ear, 1024);
    struct md_known known[PLACES] = {{0}};
    struct md_decoder decoder = {.known = known, .places = PLACES};
    struct md_channel channel = {.link = size & 1 ? MD_LINK_RTAC : MD_LINK_EXPORTED, .has_sides = size >> 1 & 1,
                                 .ticks_per_s = 1u << 20, .heard = ear.heard};
    struct md_capture capture = {.bytes = data, .len = size, .is_pcapng = is_pcapng, .channels = &channel, .count = 1};
    int state = MD_CHANNEL_FULL;
    size_t stuck = SIZE_MAX;
    while (state == MD_CHANNEL_FULL) {
        state = md_unpack(&capture);
        channel.heard.is_all = state != MD_CHANNEL_FULL;
        check_decode(&decoder, &channel.heard);
        md_forget(&channel.heard, &decoder.splitter);
        must(channel.heard.count <= MD_MOST_FRAME && channel.heard.len <= MD_MOST_FRAME);
        if (state == MD_CHANNEL_FULL && channel.heard.len == 0 && capture.at == stuck)
            break; /* a packet longer than the room, which is larger but for here */
        stuck = capture.at;
    }
    must(capture.at <= size && (state != MD_UNPACKED || capture.at == size));
    close_ear(&ear);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size < 1 || size > MOST)
        return 0;
    uint8_t *exact = malloc(size);
    memcpy(exact, data, size);
    check_split(exact, size);
    check_unpack(exact + 1, size - 1, exact[0] & 1);
    free(exact);
    return 0;
}

static size_t put_frame(uint8_t *out, unsigned seed)
{
    static const uint8_t functions[] = {1, 2, 3, 4, 5, 6, 8, 0x0F, 0x10, 0x83};
    int framing = (int)(seed % 3);
    struct md_message message = {.address = 1 + (seed >> 2 & 1), .function = functions[(seed >> 3) % 9],
                                 .start = seed >> 7 & 3, .count = 1 + (seed >> 9 & 3), .data = {0xFF}};
    if (message.function == 5 || message.function == 6 || message.function == 8)
        message.data_len = 2;
    else if (message.function <= 4)
        message.data_len = seed & 0x800 ? (uint16_t)(message.function > 2 ? 2 * message.count : 1) : 0;
    else if (seed & 0x800)
        message.data_len = message.function == 0x10 ? (uint16_t)(2 * message.count) : 1;
    if (framing == MD_DELIXI) {
        message.function = 2 + (seed >> 3) % 6;
        message.data_len = 4;
    }
    if (seed & 0x1000)
        message.exception = 2;
    int len = message.exception || (message.function <= 4 && message.data_len)
                  ? md_build_reply(framing, &message, out, MD_MOST_FRAME)
                  : md_build_request(framing, &message, out, MD_MOST_FRAME);
    return len > 0 ? (size_t)len : 0;
}

size_t LLVMFuzzerCustomMutator(uint8_t *data, size_t size, size_t most, unsigned seed)
{
    size = LLVMFuzzerMutate(data, size, most);
    for (unsigned round = seed % 5; round > 0; round--) {
        seed = seed * 1664525u + 1013904223u;
        uint8_t frame[MD_MOST_FRAME + 1];
        size_t len = put_frame(frame + 1, seed >> 8);
        if (len == 0 || len > 63 || size + len + 1 > most)
            continue;
        frame[0] = (uint8_t)(len | (seed >> 30) << 6);
        memcpy(data + size, frame, len + 1);
        size += len + 1;
    }
    return size;
}
