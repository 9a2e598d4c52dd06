/* Parse hostile bytes as a request, and as the reply to a request.
 *
 * An input is two requests (see request_of) and the received bytes. */
#include "fuzz.h"

enum { HEADER = 2 * REQUEST_BYTES, MOST_RECEIVED = 600 };

typedef int parser(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                   struct md_message *out);

static int parse_request(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                         struct md_message *out)
{
    (void)request;
    return md_parse_request(framing, bytes, len, out);
}

/* Parse each prefix of the bytes. Check that the result is MD_INCOMPLETE until it is final. Return the final
 * result. */
static int check_prefixes(parser *parse, int framing, const uint8_t *bytes, size_t len,
                          const struct md_message *request)
{
    struct md_message out;
    int decided = MD_INCOMPLETE;
    for (size_t have = 0; have <= len; have++) {
        uint8_t *exact = exact_copy(bytes, have);
        int used = parse(framing, exact, have, request, &out);
        free(exact);
        must(used <= (int)have);
        /* A frame must be accepted as soon as its last byte has come. */
        must(used <= 0 || used == (int)have || used == decided);
        must(decided == MD_INCOMPLETE || used == decided || (used < 0 && decided < 0));
        must(used != MD_BAD_REQUEST && used >= MD_BAD_ECHO);
        decided = used;
    }
    return decided;
}

/* If the parser accepts the request and the core can build such a request, check that it builds the same
 * bytes. */
static void check_request(int framing, const uint8_t *bytes, size_t len)
{
    struct md_message found;
    uint8_t built[MD_MOST_FRAME];
    int used = check_prefixes(parse_request, framing, bytes, len, NULL);
    if (used <= 0)
        return;
    must(md_parse_request(framing, bytes, len, &found) == used && found.data_len <= MD_MOST_DATA);
    int length = md_build_request(framing, &found, built, sizeof built);
    if (length < 0) { /* a drive may receive requests that the core would not build */
        must(length == MD_BAD_REQUEST);
        return;
    }
    must(length == used && memcmp(built, bytes, (size_t)used) == 0);
    must(md_reply_length(framing, &found) <= MD_MOST_FRAME &&
         (md_reply_length(framing, &found) > 0) == (found.address > 0 || framing == MD_TCP));
}

/* Check that an accepted reply matches its request. It may also be accepted as the reply to the `other`
 * request if both requests have the same address and function. */
static void check_reply(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                        const struct md_message *other)
{
    struct md_message found, again;
    uint8_t built[MD_MOST_FRAME], asked[MD_MOST_FRAME];
    int used = check_prefixes(md_parse_reply, framing, bytes, len, request);
    if (used <= 0)
        return;
    must(md_parse_reply(framing, bytes, len, request, &found) == used && found.data_len <= MD_MOST_DATA);
    must(request->address > 0 || framing == MD_TCP);
    must(found.address == request->address && found.function == request->function);
    must(found.exception || (used >= md_reply_length(framing, request) && /* usually equal */
                             used <= md_longest_reply(framing, request)));
    if (md_build_request(framing, request, asked, sizeof asked) < 0)
        return; /* the core would not send this request */
    int length = md_build_reply(framing, &found, built, sizeof built);
    must(length == used);
    if (framing == MD_DELIXI && (found.exception || found.function == 3))
        return; /* rebuilding may change digits without meaning */
    if (framing != MD_DELIXI && found.exception && found.function == 8)
        return; /* an exception to function 08 may have code 89H instead of 88H */
    if (framing == MD_TCP && found.exception) /* the length field of an exception reply may be wrong */
        memcpy(built + 4, bytes + 4, 2);
    must(memcmp(built, bytes, (size_t)used) == 0);
    /* late.c relies on this: a reply is accepted only for requests with its address and function. */
    if (md_parse_reply(framing, bytes, len, other, &again) > 0)
        must(request->address == other->address &&
             (framing == MD_DELIXI || request->function == other->function));
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size < HEADER || size > HEADER + MOST_RECEIVED)
        return 0;
    int framing = framing_of(data[0]);
    struct md_message request = request_of(data), other = request_of(data + REQUEST_BYTES);
    if (framing != framing_of(data[REQUEST_BYTES]))
        other = request;
    check_request(framing, data + HEADER, size - HEADER);
    check_reply(framing, data + HEADER, size - HEADER, &request, &other);
    return 0;
}

int find_wire(uint8_t *data, size_t size, unsigned seed, struct wire *wire)
{
    static const uint8_t functions[] = {1, 2, 3, 4, 5, 6, 8, 0x0F, 0x10};
    if (size < HEADER)
        return 0;
    wire->at = HEADER;
    wire->len = size - HEADER;
    wire->framing = framing_of(data[0]);
    wire->is_reply = seed & 1;
    if (seed & 2 && wire->is_reply) /* make both requests in the input valid, with the same function */
        for (size_t at = 0; at < HEADER; at += REQUEST_BYTES) {
            data[at] = data[0];
            data[at + 1] = data[1];
            data[at + 2] = wire->framing == MD_DELIXI ? (uint8_t)(2 + (seed >> 4) % 6)
                : functions[(seed >> 4) % sizeof functions];
            data[at + 5] = 0;
            data[at + 6] %= 126;
            if (data[at + 2] == 5) { /* a coil's data are FF00 or 0000 */
                data[at + 7] = seed & 4 ? 0xFF : 0;
                data[at + 8] = 0;
            }
        }
    wire->request = request_of(data);
    return 1;
}
