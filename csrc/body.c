/* Bodies of frames: read and write the content of requests and replies in any framing, and check whether a
 * reply confirms its request.
 *
 * The Modbus framings wrap the same bytes, address + PDU (application protocol V1.1b3). Delixi's body is A K
 * P1 P0 D3 D2 D1 D0 (address, function, parameter, data). */
#include "internal.h"

#include <string.h>

/* The fields after address and function code. */
enum layout {
    NONE,       /* the framing has no such function */
    RANGE,      /* start, count */
    DATA,       /* byte count, data */
    ECHO,       /* start, two bytes */
    RANGE_DATA, /* start, count, byte count, data */
    LONG,       /* start, four bytes: every Delixi body */
    BARE,       /* no fields */
    STATUS,     /* one byte */
    COUNTERS,   /* four bytes */
    MASK,       /* start, four bytes */
    POINTER,    /* start */
    QUEUE,      /* byte count of two bytes, data; the request does not determine the count */
    COUNTED,    /* byte count, data; the request does not determine the count */
    IDENTITY,   /* MEI type, code, object */
    OBJECTS /* MEI type, code, conformity, more, next object, number of objects; each: id, length, text */
};

static const struct fields {
    uint8_t start, count, byte_count; /* 1: the layout has this field, 0: it has not */
    uint8_t data_len;                 /* number of data bytes, if byte_count is 0 */
} fields_of[] = {
    [RANGE] = {.start = 1, .count = 1},
    [DATA] = {.byte_count = 1},
    [ECHO] = {.start = 1, .data_len = 2},
    [RANGE_DATA] = {.start = 1, .count = 1, .byte_count = 1},
    [LONG] = {.start = 1, .data_len = 4},
    [STATUS] = {.data_len = 1},
    [COUNTERS] = {.data_len = 4},
    [MASK] = {.start = 1, .data_len = 4},
    [POINTER] = {.start = 1},
    [QUEUE] = {.data_len = 2}, /* the byte count */
    [COUNTED] = {.byte_count = 1},
    [IDENTITY] = {.data_len = 3},
    [OBJECTS] = {.data_len = 6},
};

enum { BIT = 1, WORD = 16 };

/* Broadcasts have no reply, so only writes may be broadcast. */
enum { NO_BROADCAST, BROADCAST };

static const struct function {
    uint8_t request, reply; /* enum layout */
    uint8_t unit_bits;      /* BIT or WORD: the unit of count */
    uint16_t most;          /* the largest count */
    uint8_t may_be;         /* BROADCAST or NO_BROADCAST */
} functions[] = {
    [0x01] = {RANGE, DATA, BIT, 2000, NO_BROADCAST},
    [0x02] = {RANGE, DATA, BIT, 2000, NO_BROADCAST},
    [0x03] = {RANGE, DATA, WORD, 125, NO_BROADCAST},
    [0x04] = {RANGE, DATA, WORD, 125, NO_BROADCAST},
    [MD_WRITE_COIL] = {.request = ECHO, .reply = ECHO, .may_be = BROADCAST},
    [MD_WRITE_ONE] = {.request = ECHO, .reply = ECHO, .may_be = BROADCAST},
    [MD_READ_STATUS] = {.request = BARE, .reply = STATUS},
    [MD_LOOPBACK] = {.request = ECHO, .reply = ECHO},
    [0x0B] = {.request = BARE, .reply = COUNTERS}, /* event counter */
    [0x0C] = {.request = BARE, .reply = COUNTED},  /* event log */
    [0x0F] = {RANGE_DATA, RANGE, BIT, 1968, BROADCAST},
    [0x10] = {RANGE_DATA, RANGE, WORD, 123, BROADCAST},
    [MD_REPORT_ID] = {.request = BARE, .reply = COUNTED},
    [MD_MASK_WRITE] = {.request = MASK, .reply = MASK},
    [0x18] = {.request = POINTER, .reply = QUEUE},
    [MD_READ_IDENTITY] = {.request = IDENTITY, .reply = OBJECTS},
};

enum {
    EXCEPTION_BODY = 3,
    NO_PATH = 0x0A, /* a gateway's exceptions: no path to the unit, no reply from it */
    NO_TARGET = 0x0B,
    DELIXI_BODY = 8,
    MEI_IDENTITY = 0x0E, /* the MEI type of MD_READ_IDENTITY; other types have other layouts */
    MOST_DATA_BODY = 2 + MD_MOST_DATA
};

/* Delixi's function codes K that only a drive sends (Delixi's manual, part 3). */
enum { CANNOT_EXECUTE = 0xF0, FIRST_REFUSAL = 0xFC };

static const struct function *find_function(int framing, uint8_t code)
{
    static const struct function none, delixi = {.request = LONG, .reply = LONG};
    static const struct function delixi_run = {.request = LONG, .reply = LONG, .may_be = BROADCAST};
    if (framing == MD_DELIXI) /* Delixi's manual, part 3: only a run command may be broadcast */
        return code == MD_DELIXI_RUN ? &delixi_run : &delixi;
    return code < sizeof functions / sizeof *functions ? &functions[code] : &none;
}

static int is_delixi_command(uint8_t code)
{
    return code >= MD_DELIXI_RUN && code <= MD_DELIXI_PARAMETER_QUERY;
}

static int is_delixi_refusal(uint8_t code)
{
    return code == CANNOT_EXECUTE || code >= FIRST_REFUSAL;
}

static size_t data_bytes(const struct function *function, unsigned count)
{
    return (count * function->unit_bits + 7) / 8;
}

/* ---- lengths and fields ---- */

/* Return the length of a body, not counting the data that a byte count announces. */
static int head_length(int layout)
{
    const struct fields *fields = &fields_of[layout];
    return 2 + 2 * fields->start + 2 * fields->count + fields->byte_count + fields->data_len;
}

static size_t put_body(int layout, const struct md_message *message, uint8_t *body)
{
    const struct fields *fields = &fields_of[layout];
    uint8_t *at = body + 2;
    if (fields->start)
        at = md_put16(at, message->start);
    if (fields->count)
        at = md_put16(at, message->count);
    if (fields->byte_count)
        *at++ = (uint8_t)message->data_len;
    memcpy(at, message->data, message->data_len);
    return (size_t)(at - body) + message->data_len;
}

/* Return the length of a device identification (V1.1b3, 6.21). It depends on the lengths of its objects. */
static int objects_length(const uint8_t *body, size_t have)
{
    size_t at = (size_t)head_length(OBJECTS);
    if (have >= 3 && body[2] != MEI_IDENTITY)
        return MD_BAD_FUNCTION;
    if (have < at)
        return MD_INCOMPLETE;
    for (unsigned left = body[at - 1]; left > 0; left--) {
        if (have < at + 2)
            return MD_INCOMPLETE;
        at += 2U + body[at + 1];
        if (at > MOST_DATA_BODY)
            return MD_BAD_LENGTH;
    }
    return (int)at;
}

/* Write only the data bytes that the body has: clearing the unused bytes takes longer than parsing. */
static void get_body(int layout, const uint8_t *body, struct md_message *message)
{
    const struct fields *fields = &fields_of[layout];
    const uint8_t *at = body + 2;
    if (fields->start) {
        message->start = md_get16(at);
        at += 2;
    }
    if (fields->count) {
        message->count = md_get16(at);
        at += 2;
    }
    message->data_len = fields->byte_count ? *at++ : fields->data_len;
    if (layout == QUEUE)
        message->data_len = (uint16_t)(2 + md_get16(at));
    if (layout == OBJECTS)
        message->data_len = (uint16_t)(objects_length(body, MOST_DATA_BODY) - 2);
    memcpy(message->data, at, message->data_len);
}

static void begin_message(struct md_message *message, uint8_t address, uint8_t function)
{
    memset(message, 0, offsetof(struct md_message, data));
    message->address = address;
    message->function = function;
}

/* Return the length of a request's body from its first bytes; MD_INCOMPLETE if more bytes are needed. A
 * request with an invalid count is still a request if its length does not depend on the count: the drive
 * answers it with an exception. */
static int request_length(int framing, const uint8_t *body, size_t have)
{
    if (have < 2)
        return MD_INCOMPLETE;
    const struct function *function = find_function(framing, body[1]);
    if (function->request == NONE || (framing == MD_DELIXI && body[1] >= CANNOT_EXECUTE))
        return MD_BAD_FUNCTION;
    int head = head_length(function->request);
    if (function->request == IDENTITY && have >= 3 && body[2] != MEI_IDENTITY)
        return MD_BAD_FUNCTION;
    if (function->request != RANGE_DATA)
        return head;
    if (have < (size_t)head)
        return MD_INCOMPLETE;
    unsigned count = md_get16(body + 4);
    if (count > function->most || body[6] != data_bytes(function, count))
        return MD_BAD_LENGTH;
    return head + body[6];
}

/* Address 0 is the broadcast on serial lines only: with Modbus TCP, unit id 0 is a device. */
static int is_answered(int framing, uint8_t address)
{
    return address != 0 || framing == MD_TCP;
}

/* Return the length of the body of the reply to `request`; an enum md_frame_fault if the bytes cannot start
 * that reply. */
static int reply_length(int framing, const uint8_t *body, size_t have, const struct md_message *request)
{
    const struct function *function = find_function(framing, request->function);
    if (have >= 1 && (body[0] != request->address || !is_answered(framing, request->address)))
        return MD_BAD_ADDRESS;
    if (request->function & MD_EXCEPTION_BIT) /* an invalid request: only exceptions set this bit */
        return MD_BAD_FUNCTION;
    if (have < 2)
        return MD_INCOMPLETE;
    if (framing == MD_DELIXI && is_delixi_refusal(body[1]))
        return DELIXI_BODY;
    /* ERMAN's manual, section 8, shows function code 89H in an exception to function 08 (as Yaskawa's manuals
     * do). */
    if (framing != MD_DELIXI && (body[1] == (request->function | MD_EXCEPTION_BIT) ||
                                 (request->function == MD_LOOPBACK && body[1] == 0x89)))
        return have >= EXCEPTION_BODY && body[2] == 0 ? MD_BAD_FUNCTION : EXCEPTION_BODY;
    if (body[1] != request->function || function->reply == NONE)
        return MD_BAD_FUNCTION;
    int head = head_length(function->reply);
    if (function->reply == OBJECTS)
        return objects_length(body, have);
    if (function->reply != DATA && function->reply != COUNTED && function->reply != QUEUE)
        return head;
    if (have < (size_t)head)
        return MD_INCOMPLETE;
    if (function->reply == QUEUE)
        return md_get16(body + 2) <= MD_MOST_DATA - 2 ? head + md_get16(body + 2) : MD_BAD_LENGTH;
    if (function->reply == COUNTED)
        return body[2] >= 1 && body[2] <= MD_MOST_DATA ? head + body[2] : MD_BAD_LENGTH;
    unsigned count = request->count;
    if (count == 0 || count > function->most || body[2] != data_bytes(function, count))
        return MD_BAD_LENGTH;
    return head + body[2];
}

int md_body_length(int framing, const uint8_t *body, size_t have, const struct md_message *request)
{
    return request ? reply_length(framing, body, have, request) : request_length(framing, body, have);
}

int md_body_longest_reply(int framing, const struct md_message *request)
{
    int layout = find_function(framing, request->function)->reply;
    int is_open = layout == COUNTED || layout == QUEUE || layout == OBJECTS;
    return is_open ? MD_MOST_BODY : md_body_reply_length(framing, request);
}

int md_body_reply_length(int framing, const struct md_message *request)
{
    const struct function *function = find_function(framing, request->function);
    int data = function->reply == DATA ? (int)data_bytes(function, request->count) : 0;
    return is_answered(framing, request->address) ? head_length(function->reply) + data : 0;
}

/* ---- bounds ---- */

static int is_range(const struct function *function, const struct md_message *message)
{
    unsigned count = message->count;
    return count >= 1 && count <= function->most && message->start + count <= 0x10000;
}

static int is_identification(const struct md_message *message)
{
    uint8_t body[MOST_DATA_BODY];
    memcpy(body + 2, message->data, message->data_len);
    return objects_length(body, 2U + message->data_len) == 2 + message->data_len;
}

static int fits(int layout, const struct function *function, const struct md_message *message)
{
    switch (layout) {
    case RANGE:
        return is_range(function, message) && message->data_len == 0;
    case RANGE_DATA:
        return is_range(function, message) && message->data_len == data_bytes(function, message->count);
    case DATA:
        return message->data_len >= 1 && message->data_len <= data_bytes(function, function->most) &&
               8 * message->data_len % function->unit_bits == 0;
    case LONG:
        return message->data_len == 4 && is_delixi_command(message->function);
    case COUNTED:
        return message->data_len >= 1;
    case QUEUE:
        return message->data_len == 2 + md_get16(message->data);
    case IDENTITY:
        return message->data_len == 3 && message->data[0] == MEI_IDENTITY;
    case OBJECTS:
        return is_identification(message);
    default:
        return layout != NONE && message->data_len == fields_of[layout].data_len;
    }
}

static int is_coil(const uint8_t *data)
{
    return data[1] == 0 && (data[0] == 0xFF || data[0] == 0);
}

static int is_address(int framing, uint8_t address)
{
    return framing == MD_TCP || (address >= 1 && address <= MD_MOST_ADDRESS);
}

static int is_request(int framing, const struct md_message *message)
{
    const struct function *function = find_function(framing, message->function);
    int is_broadcast = message->address == 0 && function->may_be == BROADCAST;
    if (!is_broadcast && !is_address(framing, message->address))
        return 0;
    return fits(function->request, function, message) &&
           (framing == MD_DELIXI || message->function != MD_WRITE_COIL || is_coil(message->data));
}

static int is_reply(int framing, const struct md_message *message)
{
    const struct function *function = find_function(framing, message->function);
    if (!is_address(framing, message->address))
        return 0;
    if (message->exception)
        return framing != MD_DELIXI || is_delixi_refusal(message->exception);
    return fits(function->reply, function, message);
}

/* Check that the reply confirms its request. A write's reply repeats address and value, or address and count.
 * A Delixi drive (Delixi's manual, part 3, note 1) puts the value of a query into P1P0 or into D3..D0. It
 * answers all other requests with a copy of the request. */
static int confirms(int framing, const uint8_t *body, const struct md_message *request)
{
    int layout = find_function(framing, request->function)->reply;
    if (layout == STATUS) /* the body of this reply is too short to have a start field */
        return 1;
    uint16_t start = md_get16(body + 2);
    switch (layout) {
    case RANGE:
        return start == request->start && md_get16(body + 4) == request->count;
    case ECHO: /* diagnostics: only subfunction 0, the loopback, repeats the request's data */
        return start == request->start && ((request->function == MD_LOOPBACK && start != 0) ||
                                           memcmp(body + 4, request->data, 2) == 0);
    case MASK:
    case LONG: /* the value of a state query is never 0: such a reply would equal the query */
        return (request->function == MD_DELIXI_STATE_QUERY ? start != 0 : start == request->start) &&
               (request->function == MD_DELIXI_PARAMETER_QUERY || memcmp(body + 4, request->data, 4) == 0);
    case OBJECTS:
        return body[3] == request->data[1];
    default:
        return 1;
    }
}

/* ---- bodies and messages ---- */

int md_body_put_request(int framing, const struct md_message *message, uint8_t *body)
{
    if (!is_request(framing, message))
        return MD_BAD_REQUEST;
    return (int)put_body(find_function(framing, message->function)->request, message, body);
}

int md_body_put_reply(int framing, const struct md_message *message, uint8_t *body)
{
    if (!is_reply(framing, message))
        return MD_BAD_REQUEST;
    if (!message->exception)
        return (int)put_body(find_function(framing, message->function)->reply, message, body);
    if (framing == MD_DELIXI) { /* the other bytes have "no meaning" in the manual: they stay 0 */
        body[1] = message->exception;
        return DELIXI_BODY;
    }
    body[1] |= MD_EXCEPTION_BIT;
    body[2] = message->exception;
    return EXCEPTION_BODY;
}

void md_body_get_request(int framing, const uint8_t *body, struct md_message *message)
{
    begin_message(message, body[0], body[1]);
    get_body(find_function(framing, body[1])->request, body, message);
}

int md_body_get_reply(int framing, const uint8_t *body, const struct md_message *request,
                      struct md_message *reply)
{
    int is_exception = body[1] != request->function;
    if (!is_exception && !confirms(framing, body, request))
        return 0;
    begin_message(reply, body[0], request->function);
    if (is_exception) {
        reply->exception = framing == MD_DELIXI ? body[1] : body[2];
        return 1;
    }
    int layout = find_function(framing, body[1])->reply;
    get_body(layout, body, reply);
    if (layout == DATA) {
        reply->start = request->start;
        reply->count = request->count;
    }
    if (framing == MD_DELIXI && body[1] == MD_DELIXI_STATE_QUERY) /* copy the queried value to data */
        md_put16(reply->data + 2, reply->start);
    return 1;
}

int md_is_from_gateway(int framing, const struct md_message *reply)
{
    return framing == MD_TCP && (reply->exception == NO_PATH || reply->exception == NO_TARGET);
}

void md_copy_message(struct md_message *to, const struct md_message *from)
{
    memcpy(to, from, offsetof(struct md_message, data) + from->data_len);
}
