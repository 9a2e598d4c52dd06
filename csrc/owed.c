/* One request whose reply may still come: when it was sent, and what could be taken for its reply. */
#include "line.h"

#include <string.h>

enum { DATA_KEPT = sizeof((struct md_owed){0}.data), LAST_READ = 0x04 };

/* ---- what it asked for ---- */

static uint8_t data_kept(const struct md_message *request)
{
    return (uint8_t)(request->data_len < DATA_KEPT ? request->data_len : DATA_KEPT);
}

struct md_owed md_owed_of(const struct md_exchange *exchange)
{
    const struct md_message *request = &exchange->request;
    struct md_owed owed = {.framing = (uint8_t)exchange->framing, .address = request->address,
                           .function = request->function, .start = request->start, .count = request->count,
                           .reply_len = (uint16_t)md_reply_length(exchange->framing, request),
                           .least = exchange->least, .end = exchange->end,
                           .data_len = data_kept(request)};
    memcpy(owed.data, request->data, owed.data_len);
    return owed;
}

int md_owed_is_same(const struct md_owed *owed, const struct md_exchange *exchange)
{
    const struct md_message *request = &exchange->request;
    return owed->framing == exchange->framing && owed->function == request->function &&
           owed->start == request->start && owed->count == request->count &&
           owed->least == exchange->least && owed->end == exchange->end &&
           memcmp(owed->data, request->data, data_kept(request)) == 0;
}

/* ---- what could be taken for its reply ---- */

static int may_hold_the_same(const struct md_owed *owed, const struct md_exchange *exchange)
{
    return !owed->end || !exchange->end || (owed->least < exchange->end && exchange->least < owed->end);
}

int md_is_read(int framing, uint8_t function)
{
    if (framing == MD_DELIXI)
        return function == MD_DELIXI_STATE_QUERY || function == MD_DELIXI_PARAMETER_QUERY;
    return function <= LAST_READ;
}

/* A reply to the one could pass for the reply to the other. An exception does not say which write it
 * refuses, and a start that is wrongly reported as refused is a motor that is wrongly reported to stand. */
int md_owed_is_mistakable(const struct md_owed *owed, const struct md_exchange *exchange)
{
    const struct md_message *request = &exchange->request;
    if (owed->framing != exchange->framing)
        return 0;
    if (!md_is_read(exchange->framing, request->function))
        return exchange->framing == MD_DELIXI || owed->function == request->function;
    if (owed->function != request->function)
        return 0;
    if (exchange->framing == MD_DELIXI)
        return owed->start == request->start || owed->function == MD_DELIXI_STATE_QUERY;
    return owed->reply_len == md_reply_length(exchange->framing, request) &&
           may_hold_the_same(owed, exchange);
}

int md_is_in_range(const struct md_message *reply, uint16_t least, uint32_t end)
{
    uint32_t value = md_get16(reply->data);
    return end == 0 || reply->exception || reply->data_len < 2 || (value >= least && value < end);
}

int md_owed_parse(const struct md_owed *owed, const uint8_t *bytes, size_t len)
{
    struct md_message request = {.address = owed->address, .function = owed->function, .start = owed->start,
                                 .count = owed->count, .data_len = owed->data_len};
    struct md_message reply;
    memcpy(request.data, owed->data, owed->data_len);
    if (owed->framing == MD_RTU && bytes[0] != owed->address)
        return MD_BAD_ADDRESS;
    int used = md_parse_reply(owed->framing, bytes, len, &request, &reply);
    return used > 0 && !md_is_in_range(&reply, owed->least, owed->end) ? MD_BAD_ECHO : used;
}

/* ---- when it was sent ---- */

static uint32_t last_place(const struct md_owed *owed)
{
    return (owed->times < MD_TIMES_KEPT ? owed->times : MD_TIMES_KEPT) - 1;
}

int64_t md_owed_last_ns(const struct md_owed *owed)
{
    return owed->sent_ns[last_place(owed)];
}

void md_owed_add_time(struct md_owed *owed, int64_t sent_ns)
{
    if (owed->times >= MD_TIMES_KEPT)
        memmove(owed->sent_ns + 1, owed->sent_ns + 2, (MD_TIMES_KEPT - 2) * sizeof *owed->sent_ns);
    owed->times++;
    owed->sent_ns[last_place(owed)] = sent_ns;
}

void md_owed_drop_time(struct md_owed *owed)
{
    if (owed->times-- <= MD_TIMES_KEPT)
        memmove(owed->sent_ns, owed->sent_ns + 1, (MD_TIMES_KEPT - 1) * sizeof *owed->sent_ns);
}
