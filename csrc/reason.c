/* Find out why a request has no reply from what came in its place. */
#include "internal.h"

/* Weigh a reason by how much it tells. The one that tells most is reported, and of several that tell as
 * much the first: a frame from another address may hold our own further on. */
static int weight(int reason)
{
    static const uint8_t weights[] = {
        [-MD_NO_START] = 1,
        [-MD_BAD_ADDRESS] = 2,
        [-MD_BAD_FUNCTION] = 2,
        [-MD_BAD_LENGTH] = 3,
        [-MD_BAD_CHARACTER] = 4,
        [-MD_CUT_SHORT] = 5,
        [-MD_BAD_CHECKSUM] = 6,
        [-MD_BAD_ECHO] = 7,
    };
    return reason < 0 && (size_t)-reason < sizeof weights ? weights[-reason] : 0;
}

/* Where a header is damaged nothing behind it is known. */
static size_t next_at(int framing, const uint8_t *bytes, size_t len)
{
    int whole = framing == MD_TCP ? md_tcp_length(bytes, len) : 1;
    return whole > 0 ? (size_t)whole : len;
}

int md_reason(int framing, const struct md_message *request, const uint8_t *bytes, size_t len)
{
    struct md_message reply;
    int reason = MD_NO_REPLY;
    if (len)
        reason = MD_INCOMPLETE;
    for (size_t at = 0; at < len; at += next_at(framing, bytes + at, len - at)) {
        int why = md_parse_reply(framing, bytes + at, len - at, request, &reply);
        if (why == MD_INCOMPLETE)
            why = MD_CUT_SHORT;
        if (why > 0 && md_is_gateways(framing, &reply))
            return MD_NO_REPLY;
        if (weight(why) > weight(reason))
            reason = why;
    }
    return reason;
}
