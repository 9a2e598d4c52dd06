/* Split hostile bytes of a line, which come in pieces, into frames.
 *
 * An input is pieces: each has a byte with its side and pause, a byte with its length, and its bytes. */
#include "fuzz.h"

enum { MOST = 4096, HEAD = 2 };

struct ear {
    struct md_stream stream;
    struct md_splitter splitter;
    size_t passed; /* bytes reported so far */
};

static void open_ear(struct ear *ear, size_t room)
{
    *ear = (struct ear){.stream = {.room = room, .most = room}};
    ear->stream.bytes = malloc(room);
    ear->stream.pieces = malloc(room * sizeof *ear->stream.pieces);
}

static void close_ear(struct ear *ear)
{
    free(ear->stream.bytes);
    free(ear->stream.pieces);
}

/* Get the next span; return 0 without one. Check that spans have no gaps, and that frames are valid. */
static int next(struct ear *ear, struct md_span *span)
{
    memset(span, 0xAA, sizeof *span);
    size_t at = ear->splitter.at;
    struct md_message asked = ear->splitter.request, again;
    if (!md_split(&ear->splitter, &ear->stream, span)) {
        must(ear->splitter.at == at && ear->stream.len - at <= MD_MOST_FRAME);
        must(!ear->stream.is_all || at == ear->stream.len);
        return 0;
    }
    must(span->len > 0 && span->at == at && ear->splitter.at == at + span->len &&
         at + span->len <= ear->stream.len);
    ear->passed += span->len;
    uint8_t *exact = exact_copy(ear->stream.bytes + at, span->len);
    if (span->kind == MD_REQUEST || span->kind == MD_EITHER) {
        must(md_parse_request(span->framing, exact, span->len, &again) == (int)span->len);
        must(ear->splitter.request.address == again.address && ear->splitter.framing == span->framing);
    }
    if (span->kind == MD_REPLY) {
        must(md_parse_reply(span->framing, exact, span->len, &asked, &again) == (int)span->len);
        must(again.exception == span->message.exception && !ear->splitter.awaited);
    }
    free(exact);
    return 1;
}

/* Get the next frame, and its position since the start of the stream; skip junk. Return 0 without a frame. */
static int next_frame(struct ear *ear, struct md_span *span, size_t *at)
{
    while (next(ear, span))
        if (span->kind != MD_JUNK) {
            *at = ear->passed - span->len;
            return 1;
        }
    return 0;
}

/* Return the piece whose two head bytes are at position `at` of the input. Set `len` to the number of its
 * other bytes. */
static struct md_piece piece_of(const uint8_t *data, size_t size, size_t at, size_t *len)
{
    static const uint8_t sides[] = {MD_EITHER_SIDE, MD_EITHER_SIDE, MD_EITHER_SIDE, MD_EITHER_SIDE,
                                    MD_ASKING, MD_ANSWERING, MD_FAILED, MD_NOISE};
    size_t left = size - at - HEAD;
    *len = data[at + 1] < left ? data[at + 1] : left;
    return (struct md_piece){.time_ns = (int64_t)at, .side = sides[data[at] & 7],
                             .is_after_pause = data[at] >> 3 & 1};
}

/* Split the stream twice: as a whole, and with used bytes discarded after each piece. Check that the frames
 * are the same. */
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size > MOST)
        return 0;
    struct ear whole, parts;
    open_ear(&whole, size + 1);
    open_ear(&parts, size + 1);
    size_t total = 0, len = 0, whole_at = 0, part_at = 0;
    for (size_t at = 0; at + HEAD < size; at += HEAD + len) {
        struct md_piece piece = piece_of(data, size, at, &len);
        if (len)
            must(md_stream_put(&whole.stream, data + at + HEAD, len, piece));
        total += len;
    }
    whole.stream.is_all = 1;
    whole.stream.is_tcp = parts.stream.is_tcp = size % 4 == 3;
    struct md_span expected, found;
    for (size_t at = 0; at + HEAD < size; at += HEAD + len) {
        struct md_piece piece = piece_of(data, size, at, &len);
        if (len)
            must(md_stream_put(&parts.stream, data + at + HEAD, len, piece));
        parts.stream.is_all = at + HEAD + len + HEAD >= size;
        while (next_frame(&parts, &found, &part_at)) {
            must(next_frame(&whole, &expected, &whole_at));
            must(part_at == whole_at && found.len == expected.len && found.kind == expected.kind);
            must(found.time_ns == expected.time_ns && found.message.start == expected.message.start);
        }
        md_stream_forget(&parts.stream, &parts.splitter);
        must(parts.splitter.at == 0 && parts.stream.len <= MD_MOST_FRAME &&
             parts.stream.count <= parts.stream.len);
    }
    must(!next_frame(&whole, &expected, &whole_at));
    must(whole.passed == total && parts.passed == total); /* all bytes were reported, including junk */
    close_ear(&whole);
    close_ear(&parts);
    return 0;
}

/* Select a piece of the input. Often mark it as the reply to the piece before it, which may be a request. */
int find_wire(uint8_t *data, size_t size, unsigned seed, struct wire *wire)
{
    size_t len = 0, count = 0, before = 0, before_len = 0;
    for (size_t at = 0; at + HEAD < size; at += HEAD + len, count++)
        piece_of(data, size, at, &len);
    if (count == 0)
        return 0;
    size_t wanted = (seed >> 8) % count, at = 0;
    piece_of(data, size, at, &len);
    for (; wanted > 0; wanted--) {
        before = at + HEAD;
        before_len = len;
        at += HEAD + len;
        piece_of(data, size, at, &len);
    }
    wire->at = at + HEAD;
    wire->len = len;
    wire->length_at = at + 1;
    for (int framing = 0; framing < 3 && before_len && seed & 1; framing++)
        if (md_parse_request(framing, data + before, before_len, &wire->request) > 0) {
            wire->framing = framing;
            wire->is_reply = 1;
            return 1;
        }
    return 1;
}
