/* Read captures: take packets from capture files, then frames (requests and replies in all framings) from
 * packets, and then rows from frames.
 *
 * The splitter knows no drives, only the table of functions in body.c. Bytes count as a frame if a frame may
 * start there and its checksum is good. The splitter parses bytes after a request as the reply to it, then as
 * a request, then as a reply without its request. It parses at most three frames at each byte, so the cost is
 * linear in the length of garbage. */
#include "internal.h"

#include <string.h>

/* ---- packets of pcap and pcapng files; the caller reads the blocks that describe interfaces ---- */

enum {
    RECORD_HEAD = 16, /* bytes before a packet of a pcap file */
    LEAST_BLOCK = 12, /* bytes of the shortest pcapng block */
    MOST_PACKET = 1 << 16,
    RTAC_HEADER = 12,
    TAG_DISSECTOR = 12,
    TAG_PORT_OF_SENDER = 25
};

static const char tcp_dissector[] = "mbtcp"; /* Wireshark's name for Modbus TCP */

/* The port numbers by which multidrop's own capture files name the sender of a packet. */
static const struct { uint32_t port; uint8_t side; } senders[] = {
    {50000, MD_ASKING}, {502, MD_ANSWERING}, {1, MD_FAILED}, {2, MD_NOISE},
};

static uint32_t number(const struct md_capture *capture, const uint8_t *at)
{
    uint32_t value = 0;
    for (int i = 0; i < 4; i++)
        value = value << 8 | at[capture->is_big_endian ? i : 3 - i];
    return value;
}

/* Return the length of the capture's header before a frame. If its tags name the sender, set `side`; if they
 * name Modbus TCP, set the stream's `is_tcp`. */
static size_t skip_header(struct md_channel *channel, const uint8_t *packet, size_t len, uint8_t *side)
{
    uint32_t link = channel->link;
    if (link == MD_LINK_RTAC) {
        if (len > RTAC_HEADER && (packet[8] == 1 || packet[8] == 2)) /* 1: data sent, 2: data received */
            *side = packet[8] == 1 ? MD_ASKING : MD_ANSWERING;
        return len < RTAC_HEADER ? len : RTAC_HEADER;
    }
    if (link != MD_LINK_EXPORTED)
        return 0;
    for (size_t at = 0; at + 4 <= len;) {
        unsigned tag = md_get16(packet + at), size = md_get16(packet + at + 2);
        at += 4;
        if (tag == 0)
            return at;
        if (tag == TAG_DISSECTOR && size >= sizeof tcp_dissector - 1 && at + size <= len &&
            memcmp(packet + at, tcp_dissector, sizeof tcp_dissector - 1) == 0)
            channel->stream.is_tcp = 1;
        for (size_t i = 0; tag == TAG_PORT_OF_SENDER && size == 4 && at + 4 <= len && i < 4; i++)
            if (((uint32_t)md_get16(packet + at) << 16 | md_get16(packet + at + 2)) == senders[i].port)
                *side = senders[i].side;
        at += size;
    }
    return len;
}

/* Append a packet to its channel; return 0 if the channel is full. */
static int put(struct md_channel *channel, const uint8_t *packet, size_t len, uint64_t ticks)
{
    struct md_piece piece = {.is_after_pause = 1};
    size_t header = skip_header(channel, packet, len, &piece.side);
    if (header >= len)
        return 1;
    if (!channel->has_sides)
        piece.side = MD_EITHER_SIDE;
    uint64_t seconds = ticks / channel->ticks_per_s, rest = ticks % channel->ticks_per_s;
    uint64_t time_ns = seconds * 1000000000u + rest * 1000000000u / channel->ticks_per_s;
    /* an invalid time in the file may wrap around */
    piece.time_ns = (int64_t)(time_ns + (uint64_t)channel->offset_ns);
    return md_stream_put(&channel->stream, packet + header, len - header, piece);
}

static int unpack_pcap(struct md_capture *capture)
{
    struct md_channel *channel = capture->channels;
    while (capture->at < capture->len) {
        const uint8_t *record = capture->bytes + capture->at;
        size_t left = capture->len - capture->at;
        if (left < RECORD_HEAD)
            return MD_CUT;
        uint32_t len = number(capture, record + 8);
        if (len > MOST_PACKET)
            return MD_NONSENSE;
        if (left < RECORD_HEAD + len)
            return MD_CUT;
        uint64_t ticks = number(capture, record) * channel->ticks_per_s + number(capture, record + 4);
        if (!put(channel, record + RECORD_HEAD, len, ticks))
            return MD_CHANNEL_FULL;
        capture->at += RECORD_HEAD + len;
    }
    return MD_UNPACKED;
}

static int unpack_pcapng(struct md_capture *capture)
{
    while (capture->at < capture->len) {
        const uint8_t *block = capture->bytes + capture->at;
        size_t left = capture->len - capture->at;
        if (left < LEAST_BLOCK)
            return MD_CUT;
        if (number(capture, block) != MD_PACKET_BLOCK)
            return MD_OTHER_BLOCK;
        uint32_t size = number(capture, block + 4);
        if (size % 4 || size < MD_PACKET_HEAD + MD_PACKET_END || size > 2 * MOST_PACKET)
            return MD_NONSENSE;
        if (left < size)
            return MD_CUT;
        uint32_t interface = number(capture, block + 8), len = number(capture, block + 20);
        if (interface >= capture->count || len > size - MD_PACKET_HEAD - MD_PACKET_END || len > MOST_PACKET ||
            number(capture, block + size - MD_PACKET_END) != size)
            return MD_NONSENSE;
        uint64_t ticks = (uint64_t)number(capture, block + 12) << 32 | number(capture, block + 16);
        if (!put(&capture->channels[interface], block + MD_PACKET_HEAD, len, ticks))
            return MD_CHANNEL_FULL;
        capture->at += size;
    }
    return MD_UNPACKED;
}

int md_unpack(struct md_capture *capture)
{
    return capture->is_pcapng ? unpack_pcapng(capture) : unpack_pcap(capture);
}

/* ---- frames of sniffed bytes ---- */

enum { MOST_NOISE = 3 }; /* limit of noise bytes between request and reply; more may be a damaged request */

/* Return the index of the first byte after the next pause; the stream's length if no pause follows. */
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

/* Return 1 if a good reply to a request of this function is a copy of the request, or looks like one. */
static int is_echoed(int framing, uint8_t function)
{
    int is_write = function == MD_WRITE_COIL || function == MD_WRITE_ONE || function == MD_MASK_WRITE;
    return framing == MD_DELIXI || is_write || function == MD_LOOPBACK;
}

/* Return 1 if the message may be a Delixi request. A query and its reply have the same form, but the value
 * in a query is always 0. */
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

/* Read the first bytes of the body; bytes that have not come yet count as 0. */
static void read_head(int framing, const uint8_t *bytes, size_t len, uint8_t head[HEAD])
{
    int is_text = framing == MD_ASCII || framing == MD_DELIXI;
    size_t from = framing == MD_TCP ? MD_TCP_HEAD : 0;
    memset(head, 0, HEAD);
    for (size_t i = from; !is_text && i < from + HEAD && i < len; i++) /* memcpy() would be slower */
        head[i - from] = bytes[i];
    for (size_t i = 0; is_text && i < HEAD && 2 * i + 2 < len; i++) {
        int byte = md_hex_byte(bytes + 2 * i + 1);
        if (byte < 0)
            return;
        head[i] = (uint8_t)byte;
    }
}

/* Parse a reply whose request was not captured, by guessing that request. */
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
        message->count = 0; /* a reply does not contain the count */
    return used;
}

/* Parse the frame at `bytes`: return its length, and set kind, framing and message in `span`. `least` is
 * MD_INCOMPLETE while more bytes may come, otherwise 1. */
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

/* Parse the frame at index `at`, which is in the splitter's piece. The next pause is before index `end`. */
static int look_at(const struct md_splitter *splitter, const struct md_stream *stream, size_t at, size_t end,
                   struct md_span *span)
{
    const struct md_piece *piece = &stream->pieces[splitter->piece];
    /* A frame that starts inside junk must end before the next pause, because a good frame may follow. */
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
        int side = pieces[splitter->piece].side;
        is_junk = side == MD_FAILED || side == MD_NOISE; /* the capture says that this is not a frame */
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
        /* without pass(): the frames before and after this junk still count as adjacent */
        span->kind = MD_JUNK;
        size_t next = splitter->piece + 1;
        splitter->at = next < stream->count ? pieces[next].at : stream->len;
        span->len = splitter->at - span->at;
        return 1;
    }
    if (span->len)
        span->kind = MD_JUNK; /* the next call finds the frame after this junk */
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
        if (piece->at < gone) /* the bytes directly after the pause are discarded */
            piece->is_after_pause = 0;
        piece->at = piece->at < gone ? 0 : piece->at - gone;
    }
    splitter->at = splitter->piece = 0;
}

/* ---- rows of sniffed bytes ---- */

static int is_run_command(int framing, const struct md_message *request)
{
    return framing == MD_DELIXI && request->function == MD_DELIXI_RUN;
}

/* Requests with the same key have replies with the same fields. In a Delixi run request, the command is in
 * the field that holds the register's address in other requests. */
static uint64_t key_of(int framing, const struct md_message *request)
{
    uint64_t start = is_run_command(framing, request) ? 0 : request->start;
    return 1 | (uint64_t)framing << 1 | (uint64_t)request->address << 8 | (uint64_t)request->function << 16 |
           start << 24 | (uint64_t)request->count << 40;
}

/* Return the slot of the table that holds this key, or else the empty slot in which the key belongs. */
static struct md_known *place_of(const struct md_decoder *decoder, uint64_t key)
{
    size_t place = (size_t)(key * 0x9E3779B97F4A7C15u >> 32);
    while (decoder->known[place &= decoder->places - 1].key && decoder->known[place].key != key)
        place++;
    return &decoder->known[place];
}

int md_know(struct md_decoder *decoder, int framing, const struct md_message *request,
            const struct md_block *block)
{
    if (4 * decoder->taken >= 3 * decoder->places)
        return 0;
    uint64_t key = key_of(framing, request);
    *place_of(decoder, key) = (struct md_known){key, block};
    decoder->taken++;
    return 1;
}

/* Copy the written data from the request if the reply does not repeat it. */
static void put_written(struct md_message *reply, int framing, const struct md_message *request)
{
    if (reply->exception)
        return;
    if (is_run_command(framing, request))
        md_put16(reply->data + 2, request->start);
    else if (framing != MD_DELIXI && request->function >= 0x0F)
        md_copy_message(reply, request);
}

/* Add the rows of the last request: each has a value, or a status that states why there is no reply. Return 0
 * if the columns are full. */
static int add_rows(struct md_decoder *decoder, int result, struct md_columns *columns)
{
    struct md_completion *completion = &decoder->completion;
    if (!decoder->block)
        return 1;
    completion->result = result;
    completion->sent_ns = decoder->asked_ns;
    completion->first_ns = decoder->span.time_ns;
    if (result > 0) {
        md_copy_message(&completion->reply, &decoder->span.message);
        put_written(&completion->reply, decoder->span.framing, &decoder->splitter.request);
    }
    if (!md_columns_add(columns, decoder->block, completion, 0))
        return 0;
    decoder->block = NULL;
    return 1;
}

/* Add the rows of the previous request, then look up the fields in the reply to the new one. */
static int take_request(struct md_decoder *decoder, struct md_columns *columns)
{
    const struct md_span *span = &decoder->span;
    if (!add_rows(decoder, decoder->failure, columns))
        return MD_NO_ROOM;
    const struct md_known *known = place_of(decoder, key_of(span->framing, &span->message));
    if (!known->key)
        return MD_UNKNOWN;
    decoder->block = known->block;
    decoder->asked_ns = span->time_ns;
    decoder->failure = MD_NO_REPLY;
    decoder->completion.raw_len = 0;
    return MD_ALL_DECODED;
}

/* Append the span to the bytes that came instead of a reply. Set `failure` to the reason why these bytes are
 * not a reply. */
static void explain(struct md_decoder *decoder, const struct md_stream *stream)
{
    const struct md_span *span = &decoder->span;
    struct md_completion *completion = &decoder->completion;
    size_t room = sizeof completion->raw - completion->raw_len, len = span->len < room ? span->len : room;
    if (span->side == MD_NOISE || len == 0)
        return;
    memcpy(completion->raw + completion->raw_len, stream->bytes + span->at, len);
    completion->raw_len = (uint16_t)(completion->raw_len + len);
    const struct md_splitter *splitter = &decoder->splitter;
    decoder->failure = md_reason(splitter->framing, &splitter->request, completion->raw, completion->raw_len);
}

/* Return the reply's length; MD_NO_REPLY if it is a gateway's exception for a silent drive. */
static int reply_result(const struct md_span *span)
{
    return md_is_from_gateway(span->framing, &span->message) ? MD_NO_REPLY : (int)span->len;
}

static int take(struct md_decoder *decoder, const struct md_stream *stream, struct md_columns *columns)
{
    const struct md_span *span = &decoder->span;
    switch (span->kind) {
    case MD_REQUEST:
    case MD_EITHER:
        if (!decoder->is_sure)
            /* no rows: the previous frame may have been the reply to a write, not a request */
            decoder->block = NULL;
        int undone = take_request(decoder, columns);
        if (undone)
            return undone;
        decoder->is_sure = span->kind == MD_REQUEST;
        break;
    case MD_REPLY:
        if (!add_rows(decoder, reply_result(span), columns))
            return MD_NO_ROOM;
        break;
    default:
        if (decoder->block)
            explain(decoder, stream);
    }
    decoder->frames += span->kind != MD_JUNK;
    decoder->exchanges += span->kind == MD_REPLY;
    decoder->strays += span->kind == MD_STRAY;
    decoder->junk += span->kind == MD_JUNK ? span->len : 0;
    return MD_ALL_DECODED;
}

int md_decode(struct md_decoder *decoder, const struct md_stream *stream, struct md_columns *columns)
{
    while (decoder->is_due || md_split(&decoder->splitter, stream, &decoder->span)) {
        int undone = take(decoder, stream, columns);
        decoder->is_due = undone != MD_ALL_DECODED;
        if (undone)
            return undone;
    }
    return MD_ALL_DECODED;
}
