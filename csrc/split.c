/* Cut the bytes that were sniffed on a line into frames of both directions and every framing.
 *
 * Nothing is known beforehand but the table of functions: a frame is what has a good checksum where
 * a frame may be. Bytes behind a request are first tried as its reply, then as a request, then as a
 * reply without its request. At most three frames are tried at a byte, so that garbage costs no more
 * than its length. */
#include "internal.h"

#include <string.h>

enum { MOST_NOISE = 3 }; /* bytes between a request and its reply; in more of them a request may be lost */

/* Find the end of the bytes that came without a pause from this piece on. */
static size_t end_of_run(const struct md_stream *stream, size_t piece)
{
    while (++piece < stream->count)
        if (stream->pieces[piece].is_after_pause)
            return stream->pieces[piece].at;
    return stream->len;
}

static int is_start(int framing, uint8_t first)
{
    if (framing == MD_TCP)
        return 1;
    return framing == MD_RTU ? first <= MD_MOST_ADDRESS : first == ':';
}

/* A good reply to such a request is its copy, or looks like one. */
static int is_echoed(int framing, uint8_t function)
{
    int is_write = function == MD_WRITE_COIL || function == MD_WRITE_ONE;
    return framing == MD_DELIXI || is_write || function == MD_LOOPBACK;
}

/* Delixi's requests look like replies, but the value that a query asks for is 0 in it. */
static int is_delixi_request(const struct md_message *message)
{
    static const uint8_t zeros[4];
    if (message->function == MD_DELIXI_STATE_QUERY)
        return message->start == 0;
    if (message->function == MD_DELIXI_PARAMETER_QUERY)
        return memcmp(message->data, zeros, sizeof zeros) == 0;
    return message->function >= MD_DELIXI_RUN && message->function < MD_DELIXI_PARAMETER_QUERY;
}

static int find_request(int framing, const uint8_t *bytes, size_t len, struct md_message *message)
{
    int used = md_parse_request(framing, bytes, len, message);
    if (used <= 0)
        return used;
    if (framing == MD_DELIXI && !is_delixi_request(message))
        return MD_BAD_FUNCTION;
    return framing != MD_TCP && message->address > MD_MOST_ADDRESS ? MD_BAD_ADDRESS : used;
}

enum { HEAD = 6 };

/* Read the first bytes of the body; 0 where there are none. */
static void read_head(int framing, const uint8_t *bytes, size_t len, uint8_t head[HEAD])
{
    memset(head, 0, HEAD);
    if (framing == MD_TCP) {
        for (size_t i = 0; i < HEAD && MD_TCP_HEAD + i < len; i++)
            head[i] = bytes[MD_TCP_HEAD + i];
        return;
    }
    for (size_t i = 0; framing == MD_RTU && i < HEAD && i < len; i++) /* memcpy() would be slower */
        head[i] = bytes[i];
    for (size_t i = 0; framing != MD_RTU && i < HEAD && 2 * i + 2 < len; i++) {
        int byte = md_hex_byte(bytes + 2 * i + 1);
        if (byte < 0)
            return;
        head[i] = (uint8_t)byte;
    }
}

/* Find a reply without its request: guess the request that it would be a good reply to. */
static int find_reply(int framing, const uint8_t *bytes, size_t len, struct md_message *message)
{
    uint8_t head[HEAD];
    read_head(framing, bytes, len, head);
    struct md_message guess = {.address = head[0], .function = head[1] & 0x7F};
    if (framing != MD_DELIXI && guess.function > 0x10)
        return MD_BAD_FUNCTION;
    if (guess.function <= 0x02)
        guess.count = (uint16_t)(8 * head[2]);
    else if (guess.function <= 0x04)
        guess.count = head[2] / 2;
    else {
        guess.start = md_get16(head + 2);
        guess.count = md_get16(head + 4);
    }
    int used = md_parse_reply(framing, bytes, len, &guess, message);
    if (used > 0 && guess.function <= 0x04)
        message->count = 0; /* unknown */
    return used;
}

/* Find the frame that begins here: return its length, and set its kind, framing and message in `span`.
 * `least` is MD_INCOMPLETE as long as more bytes may come, and 1 when these are all. */
static int find_frame(const struct md_splitter *splitter, int is_tcp, int side, const uint8_t *bytes,
                      size_t len, int least, struct md_span *span)
{
    static const int serial[] = {MD_ASCII, MD_DELIXI, MD_RTU}, network[] = {MD_TCP};
    const int *framings = is_tcp ? network : serial;
    int count = is_tcp ? 1 : 3;
    struct md_message *message = &span->message;
    int used, may_be_copy = !splitter->is_in_step && side != MD_ASKING;
    if (splitter->awaited && side != MD_ASKING) {
        span->kind = MD_REPLY;
        span->framing = splitter->framing;
        used = md_parse_reply(splitter->framing, bytes, len, &splitter->request, message);
        if (used >= least)
            return used;
    }
    for (int i = 0; i < count && side != MD_ANSWERING; i++) {
        int framing = span->framing = framings[i];
        if (is_start(framing, bytes[0]) && (used = find_request(framing, bytes, len, message)) >= least) {
            int is_either = used > 0 && may_be_copy && is_echoed(framing, message->function);
            span->kind = is_either ? MD_EITHER : MD_REQUEST;
            return used;
        }
    }
    span->kind = MD_STRAY;
    for (int i = 0; i < count && side != MD_ASKING; i++) {
        int framing = span->framing = framings[i];
        if (is_start(framing, bytes[0]) && (used = find_reply(framing, bytes, len, message)) >= least)
            return used;
    }
    return MD_NO_START;
}

static void pass(struct md_splitter *splitter, const struct md_span *span)
{
    splitter->at += span->len;
    splitter->is_in_step = span->kind != MD_JUNK;
    splitter->junk = span->kind == MD_JUNK ? splitter->junk + span->len : 0;
    if (span->kind == MD_REPLY || splitter->junk > MOST_NOISE)
        splitter->awaited = 0;
    if (span->kind != MD_REQUEST && span->kind != MD_EITHER)
        return;
    md_copy_message(&splitter->request, &span->message);
    splitter->framing = span->framing;
    splitter->awaited = span->message.address != 0 || span->framing == MD_TCP;
}

/* Whoever captured these bytes says that they are no frames. */
static int is_ruled_out(const struct md_piece *piece)
{
    return piece->side == MD_FAILED || piece->side == MD_NOISE;
}

/* Find the frame at `at`, which is in the splitter's piece; `end` is that of its run. */
static int look_at(const struct md_splitter *splitter, const struct md_stream *stream, size_t at, size_t end,
                   struct md_span *span)
{
    const struct md_piece *piece = &stream->pieces[splitter->piece];
    /* A pause ends what begins amid junk: it must not swallow the good frame behind the pause. */
    int is_due = (at == splitter->at && splitter->junk == 0) || (piece->at == at && piece->is_after_pause);
    size_t limit = is_due ? stream->len : end;
    int least = limit < stream->len || stream->is_all ? 1 : MD_INCOMPLETE;
    return find_frame(splitter, stream->is_tcp, piece->side, stream->bytes + at, limit - at, least, span);
}

int md_split(struct md_splitter *splitter, const struct md_stream *stream, struct md_span *span)
{
    const struct md_piece *pieces = stream->pieces;
    size_t at = splitter->at, end = 0;
    int used = MD_INCOMPLETE, is_junk = 0;
    for (; at < stream->len; at++) {
        while (splitter->piece + 1 < stream->count && pieces[splitter->piece + 1].at <= at)
            splitter->piece++;
        if (at == splitter->at) {
            span->time_ns = pieces[splitter->piece].time_ns;
            span->side = pieces[splitter->piece].side;
        }
        is_junk = is_ruled_out(&pieces[splitter->piece]);
        if (is_junk)
            break;
        if (at >= end)
            end = end_of_run(stream, splitter->piece);
        used = look_at(splitter, stream, at, end, span);
        if (used >= 0)
            break;
    }
    span->at = splitter->at;
    span->len = at - splitter->at;
    if (!span->len && is_junk) {
        span->kind = MD_JUNK; /* it says nothing of the frames around it */
        size_t next = splitter->piece + 1;
        splitter->at = next < stream->count ? pieces[next].at : stream->len;
        span->len = splitter->at - span->at;
        return 1;
    }
    if (span->len)
        span->kind = MD_JUNK; /* the frame behind it is found again */
    else if (used <= 0)
        return 0;
    else
        span->len = (size_t)used;
    pass(splitter, span);
    return 1;
}

/* ---- the stream ---- */

int md_stream_put(struct md_stream *stream, const uint8_t *bytes, size_t len, struct md_piece piece)
{
    if (stream->room - stream->len < len || stream->most == stream->count)
        return 0;
    piece.at = stream->len;
    memcpy(stream->bytes + stream->len, bytes, len);
    stream->len += len;
    stream->pieces[stream->count++] = piece;
    return 1;
}

void md_stream_forget(struct md_stream *stream, struct md_splitter *splitter)
{
    size_t gone = splitter->at, first = splitter->piece;
    while (first + 1 < stream->count && stream->pieces[first + 1].at <= gone)
        first++;
    if (gone == stream->len)
        first = stream->count;
    memmove(stream->bytes, stream->bytes + gone, stream->len - gone);
    stream->len -= gone;
    stream->count -= first;
    memmove(stream->pieces, stream->pieces + first, stream->count * sizeof *stream->pieces);
    for (size_t i = 0; i < stream->count; i++) {
        struct md_piece *piece = &stream->pieces[i];
        if (piece->at < gone) /* its pause was before what is gone */
            piece->is_after_pause = 0;
        piece->at = piece->at < gone ? 0 : piece->at - gone;
    }
    splitter->at = splitter->piece = 0;
}
