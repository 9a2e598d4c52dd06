/* Make rows of sniffed bytes, as fast as a disk delivers them. */
#include "internal.h"

#include <string.h>

static int is_run_command(int framing, const struct md_message *request)
{
    return framing == MD_DELIXI && request->function == MD_DELIXI_RUN;
}

/* Requests with one key have replies with the same fields. A Delixi run command stands where other
 * requests have their address. */
static uint64_t key_of(int framing, const struct md_message *request)
{
    uint64_t start = is_run_command(framing, request) ? 0 : request->start;
    return 1 | (uint64_t)framing << 1 | (uint64_t)request->address << 8 | (uint64_t)request->function << 16 |
           start << 24 | (uint64_t)request->count << 40;
}

/* Find the place of the key, or the empty one for it. */
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

/* Take the written data from the request, where the reply does not repeat it. */
static void put_written(struct md_message *reply, int framing, const struct md_message *request)
{
    if (reply->exception)
        return;
    if (is_run_command(framing, request))
        md_put16(reply->data + 2, request->start);
    else if (framing != MD_DELIXI && request->function >= 0x0F)
        md_copy_message(reply, request);
}

/* Add the rows of the last request: its reply, or why there is none. Return 0 when there is no room. */
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

/* Add the rows of the request before this one, then look up the fields of its own reply. */
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

/* Learn why there is no reply from what came in its place. */
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

static int take(struct md_decoder *decoder, const struct md_stream *stream, struct md_columns *columns)
{
    const struct md_span *span = &decoder->span;
    switch (span->kind) {
    case MD_REQUEST:
    case MD_EITHER:
        if (!decoder->is_sure)
            decoder->block = NULL; /* it may have been a confirmation: nobody failed to answer it */
        int undone = take_request(decoder, columns);
        if (undone)
            return undone;
        decoder->is_sure = span->kind == MD_REQUEST;
        break;
    case MD_REPLY:
        if (!add_rows(decoder, md_is_gateways(span->framing, &span->message) ? MD_NO_REPLY : (int)span->len,
                      columns))
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
