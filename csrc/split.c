/* What was sniffed on a line, cut into frames of both directions and every framing.
 *
 * Nothing is known beforehand but the table of functions: a frame is what has a good checksum where
 * a frame may be. What follows a request is first tried as its reply, then as a request, then as a
 * reply whose request was not stream. At most three frames are tried at a byte, so that garbage costs
 * no more than its length. */
#include "internal.h"

#include <string.h>

enum {
    MOST_ADDRESS = 247,
    MOST_NOISE = 3 /* bytes between a request and its reply; in more of them a request may be lost */
};

/* Delixi's K (part 3). */
enum { RUN_COMMAND = 2, STATE_QUERY = 3, PARAMETER_QUERY = 7 };

/* Bytes that follow `at` in its piece, and in the pieces that came without a pause. */
static size_t end_of_run(const struct md_stream *stream, size_t piece)
{
    while (++piece < stream->count)
        if (stream->pieces[piece].is_after_pause)
            return stream->pieces[piece].at;
    return stream->len;
}

/* In which framings a frame may be that begins with this byte: in Modbus RTU an address. */
static int is_start(int framing, uint8_t first)
{
    return framing == MD_RTU ? first <= MOST_ADDRESS : first == ':';
}

/* Requests that a good reply is a copy of, or like one. */
static int is_echoed(int framing, uint8_t function)
{
    return framing == MD_DELIXI || function == 0x05 || function == 0x06 || function == 0x08;
}

/* Delixi's requests look like replies, but what is asked for is 0 in a query. */
static int is_delixi_request(const struct md_message *message)
{
    static const uint8_t zeros[4];
    if (message->function == STATE_QUERY)
        return message->start == 0;
    if (message->function == PARAMETER_QUERY)
        return memcmp(message->data, zeros, sizeof zeros) == 0;
    return message->function >= RUN_COMMAND && message->function < PARAMETER_QUERY;
}

static int find_request(int framing, const uint8_t *bytes, size_t len, struct md_message *message)
{
    int used = md_parse_request(framing, bytes, len, message);
    if (used <= 0)
        return used;
    if (framing == MD_DELIXI && !is_delixi_request(message))
        return MD_BAD_FUNCTION;
    return message->address > MOST_ADDRESS ? MD_BAD_ADDRESS : used;
}

/* The first bytes of the body, 0 where there are none. */
static void read_head(int framing, const uint8_t *bytes, size_t len, uint8_t head[6])
{
    memset(head, 0, 6);
    for (size_t i = 0; i < 6; i++) {
        if (framing == MD_RTU && i < len)
            head[i] = bytes[i];
        if (framing == MD_RTU || 2 * i + 2 >= len)
            continue;
        int byte = md_hex_byte(bytes + 2 * i + 1);
        if (byte < 0)
            return;
        head[i] = (uint8_t)byte;
    }
}

/* A reply without its request: it is held against the request that it would be a good answer to. */
static int find_reply(int framing, const uint8_t *bytes, size_t len, struct md_message *message)
{
    uint8_t head[6];
    read_head(framing, bytes, len, head);
    struct md_message guess = {.address = head[0], .function = head[1] & 0x7F};
    if (framing != MD_DELIXI && guess.function > 0x10)
        return MD_BAD_FUNCTION;
    if (guess.function <= 0x02)
        guess.count = (uint16_t)(8 * head[2]);
    else if (guess.function <= 0x04)
        guess.count = head[2] / 2;
    else {
        guess.start = (uint16_t)(head[2] << 8 | head[3]);
        guess.count = (uint16_t)(head[4] << 8 | head[5]);
    }
    int used = md_parse_reply(framing, bytes, len, &guess, message);
    if (used > 0 && guess.function <= 0x04)
        message->count = 0; /* nobody knows what was asked for */
    return used;
}

/* The frame that begins here: its length, and its kind, framing and message in `span`. `least` is
 * MD_INCOMPLETE as long as more bytes may come, and 1 when these are all. */
static int find_frame(const struct md_splitter *splitter, int side, const uint8_t *bytes, size_t len,
                      int least, struct md_span *span)
{
    static const int framings[] = {MD_ASCII, MD_DELIXI, MD_RTU};
    if (splitter->awaited && side != MD_ASKING) {
        int used = md_parse_reply(splitter->framing, bytes, len, &splitter->request, &span->message);
        span->kind = MD_REPLY;
        span->framing = splitter->framing;
        if (used >= least)
            return used;
    }
    for (int i = 0; i < 3 && side != MD_ANSWERING; i++) {
        if (!is_start(framings[i], bytes[0]))
            continue;
        int used = find_request(framings[i], bytes, len, &span->message);
        int may_be_copy = !splitter->is_in_step && side != MD_ASKING;
        span->kind = used > 0 && may_be_copy && is_echoed(framings[i], span->message.function) ? MD_EITHER : MD_REQUEST;
        span->framing = framings[i];
        if (used >= least)
            return used;
    }
    for (int i = 0; i < 3 && side != MD_ASKING; i++) {
        if (!is_start(framings[i], bytes[0]))
            continue;
        int used = find_reply(framings[i], bytes, len, &span->message);
        span->kind = MD_STRAY;
        span->framing = framings[i];
        if (used >= least)
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
    splitter->awaited = span->message.address != 0;
}

/* Bytes of which who captured them says that they are no frames. */
static int is_ruled_out(const struct md_piece *piece)
{
    return piece->side == MD_FAILED || piece->side == MD_NOISE;
}

int md_split(struct md_splitter *splitter, const struct md_stream *stream, struct md_span *span)
{
    const struct md_piece *pieces = stream->pieces;
    size_t at = splitter->at, end = 0;
    int used = MD_INCOMPLETE;
    for (; at < stream->len; at++) {
        while (splitter->piece + 1 < stream->count && pieces[splitter->piece + 1].at <= at)
            splitter->piece++;
        if (at == splitter->at) {
            span->time_ns = pieces[splitter->piece].time_ns;
            span->side = pieces[splitter->piece].side;
        }
        if (is_ruled_out(&pieces[splitter->piece]))
            break;
        if (at >= end)
            end = end_of_run(stream, splitter->piece);
        /* A pause ends what begins amid junk: it must not swallow the good frame behind the pause. */
        const struct md_piece *piece = &pieces[splitter->piece];
        int is_due = (at == splitter->at && splitter->junk == 0) || (piece->at == at && piece->is_after_pause);
        size_t limit = is_due ? stream->len : end;
        int least = limit < stream->len || stream->is_all ? 1 : MD_INCOMPLETE;
        used = find_frame(splitter, piece->side, stream->bytes + at, limit - at, least, span);
        if (used >= 0)
            break;
    }
    span->at = splitter->at;
    span->len = at - splitter->at;
    if (!span->len && at < stream->len && is_ruled_out(&pieces[splitter->piece])) {
        span->kind = MD_JUNK; /* which says nothing of the frames around it */
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
