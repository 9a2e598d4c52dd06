/* Requests and replies in four framings: Modbus RTU, Modbus ASCII, Modbus TCP, Delixi's own ASCII.
 *
 * The Modbus framings wrap the same bytes, address + PDU (application protocol V1.1b3, serial-line
 * guide V1.02, messaging guide for TCP/IP V1.0b); here they are called the body. Delixi's body is
 * A K P1 P0 D3 D2 D1 D0. */
#include "internal.h"

#include <string.h>

/* The fields behind address and function code. */
enum layout {
    NONE,       /* no such function */
    RANGE,      /* start, count */
    DATA,       /* byte count, data */
    ECHO,       /* start, two bytes */
    RANGE_DATA, /* start, count, byte count, data */
    LONG        /* start, four bytes: all of Delixi's */
};

static const struct fields {
    uint8_t start, count, byte_count; /* 1: there is one */
    uint8_t data_len;                 /* without a byte count */
} fields_of[] = {
    [RANGE] = {.start = 1, .count = 1},
    [DATA] = {.byte_count = 1},
    [ECHO] = {.start = 1, .data_len = 2},
    [RANGE_DATA] = {.start = 1, .count = 1, .byte_count = 1},
    [LONG] = {.start = 1, .data_len = 4},
};

enum { BIT = 1, WORD = 16 };

/* Nobody answers a broadcast, so that it cannot ask for anything. */
enum { NO_BROADCAST, BROADCAST };

static const struct function {
    uint8_t request, reply; /* enum layout */
    uint8_t unit_bits;      /* BIT or WORD: the unit of count */
    uint16_t most;          /* the largest count */
    uint8_t may_be;         /* BROADCAST, or not */
} functions[] = {
    [0x01] = {RANGE, DATA, BIT, 2000, NO_BROADCAST},
    [0x02] = {RANGE, DATA, BIT, 2000, NO_BROADCAST},
    [0x03] = {RANGE, DATA, WORD, 125, NO_BROADCAST},
    [0x04] = {RANGE, DATA, WORD, 125, NO_BROADCAST},
    [MD_WRITE_COIL] = {.request = ECHO, .reply = ECHO, .may_be = BROADCAST},
    [MD_WRITE_ONE] = {.request = ECHO, .reply = ECHO, .may_be = BROADCAST},
    [MD_LOOPBACK] = {.request = ECHO, .reply = ECHO},
    [0x0F] = {RANGE_DATA, RANGE, BIT, 1968, BROADCAST},
    [0x10] = {RANGE_DATA, RANGE, WORD, 123, BROADCAST},
};

enum {
    MOST_BODY = 253, /* 125 registers read; the standard has room for 254 */
    EXCEPTION_BODY = 3,
    NO_PATH = 0x0A, /* of a gateway: it cannot reach the unit, or has no reply from it */
    NO_TARGET = 0x0B,
    EXCEPTION_BIT = 0x80,
    DELIXI_BODY = 8
};

/* Delixi's K that only a drive sends (part 3). */
enum { CANNOT_EXECUTE = 0xF0, FIRST_REFUSAL = 0xFC };

static const struct function *find_function(int framing, uint8_t code)
{
    static const struct function none, delixi = {.request = LONG, .reply = LONG};
    static const struct function delixi_run = {.request = LONG, .reply = LONG, .may_be = BROADCAST};
    if (framing == MD_DELIXI) /* part 3: only a run command may be broadcast */
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

/* ---- bodies ---- */

/* Return the length of a body but for the data that a byte count announces. */
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

/* Write no more data than there is: clearing the rest costs more than to parse. */
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
    memcpy(message->data, at, message->data_len);
}

static void begin_message(struct md_message *message, uint8_t address, uint8_t function)
{
    memset(message, 0, offsetof(struct md_message, data));
    message->address = address;
    message->function = function;
}

/* Return the length of a request's body by its first bytes; MD_INCOMPLETE where they do not tell yet. A
 * count that cannot be answered is still a request, where the length does not depend on it: the
 * drive's side answers it with an exception. */
static int request_length(int framing, const uint8_t *body, size_t have)
{
    if (have < 2)
        return MD_INCOMPLETE;
    const struct function *function = find_function(framing, body[1]);
    if (function->request == NONE || (framing == MD_DELIXI && body[1] >= CANNOT_EXECUTE))
        return MD_BAD_FUNCTION;
    int head = head_length(function->request);
    if (function->request != RANGE_DATA)
        return head;
    if (have < (size_t)head)
        return MD_INCOMPLETE;
    unsigned count = md_get16(body + 4);
    if (count > function->most || body[6] != data_bytes(function, count))
        return MD_BAD_LENGTH;
    return head + body[6];
}

/* Only a serial line has broadcasts: a unit id of Modbus TCP is any. */
static int is_answered(int framing, uint8_t address)
{
    return address != 0 || framing == MD_TCP;
}

/* Do the same for the reply to `request`, which is refused as soon as its first bytes differ. */
static int reply_length(int framing, const uint8_t *body, size_t have, const struct md_message *request)
{
    const struct function *function = find_function(framing, request->function);
    if (have >= 1 && (body[0] != request->address || !is_answered(framing, request->address)))
        return MD_BAD_ADDRESS;
    if (request->function & EXCEPTION_BIT) /* no request has it */
        return MD_BAD_FUNCTION;
    if (have < 2)
        return MD_INCOMPLETE;
    if (framing == MD_DELIXI && is_delixi_refusal(body[1]))
        return DELIXI_BODY;
    /* ERMAN, section 8, prints 89H for an exception to 08 (as Yaskawa's manuals do). */
    if (framing != MD_DELIXI && (body[1] == (request->function | EXCEPTION_BIT) ||
                                 (request->function == MD_LOOPBACK && body[1] == 0x89)))
        return have >= EXCEPTION_BODY && body[2] == 0 ? MD_BAD_FUNCTION : EXCEPTION_BODY;
    if (body[1] != request->function || function->reply == NONE)
        return MD_BAD_FUNCTION;
    int head = head_length(function->reply);
    if (function->reply != DATA)
        return head;
    if (have < (size_t)head)
        return MD_INCOMPLETE;
    unsigned count = request->count;
    if (count == 0 || count > function->most || body[2] != data_bytes(function, count))
        return MD_BAD_LENGTH;
    return head + body[2];
}

/* ---- frames ---- */

static inline int body_length(int framing, const uint8_t *body, size_t have, const struct md_message *request)
{
    return request ? reply_length(framing, body, have, request) : request_length(framing, body, have);
}

static int hex_digit(uint8_t character)
{
    if (character >= '0' && character <= '9')
        return character - '0';
    if (character >= 'A' && character <= 'F')
        return character - 'A' + 10;
    return -1;
}

int md_hex_byte(const uint8_t digits[2])
{
    int high = hex_digit(digits[0]), low = hex_digit(digits[1]);
    return high < 0 || low < 0 ? -1 : high << 4 | low;
}

static uint8_t text_checksum(int framing, const uint8_t *body, size_t len)
{
    return framing == MD_ASCII ? md_lrc(body, len) : md_sum(body, len);
}

/* Open what is written in hex digits: unhex its body, and return the frame's length. */
static int open_text(int framing, const uint8_t *text, size_t len, const struct md_message *request,
                     uint8_t body[MOST_BODY + 1])
{
    if (len > 0 && text[0] != ':')
        return MD_NO_START;
    size_t have = 0;
    int byte = 0;
    for (; have <= MOST_BODY && 2 * have + 2 < len && (byte = md_hex_byte(text + 2 * have + 1)) >= 0; have++)
        body[have] = (uint8_t)byte;
    int length = body_length(framing, body, have, request);
    if (length < 0)
        return length;
    if (length == 0 || have <= (size_t)length) /* the checksum's byte follows the body */
        return byte < 0 ? MD_BAD_CHARACTER : MD_INCOMPLETE;
    size_t end = 2 * (size_t)length + 3;
    if ((len > end && text[end] != '\r') || (len > end + 1 && text[end + 1] != '\n'))
        return MD_BAD_CHARACTER;
    if (len < end + 2)
        return MD_INCOMPLETE;
    if (body[length] != text_checksum(framing, body, (size_t)length))
        return MD_BAD_CHECKSUM;
    return (int)end + 2;
}

static int open_rtu(const uint8_t *bytes, size_t len, const struct md_message *request, const uint8_t **body)
{
    int length = body_length(MD_RTU, bytes, len, request);
    if (length <= 0)
        return length;
    if (len < (size_t)length + 2)
        return MD_INCOMPLETE;
    uint16_t crc = md_crc16(bytes, (size_t)length);
    if (bytes[length] != (crc & 0xFF) || bytes[length + 1] != crc >> 8)
        return MD_BAD_CHECKSUM;
    *body = bytes;
    return length + 2;
}

int md_tcp_length(const uint8_t *bytes, size_t len)
{
    if (len >= 4 && md_get16(bytes + 2) != 0) /* the protocol */
        return MD_NO_START;
    if (len < MD_TCP_HEAD)
        return MD_INCOMPLETE;
    int whole = MD_TCP_HEAD + md_get16(bytes + 4);
    return whole < MD_TCP_HEAD + 2 || whole > MD_MOST_TCP ? MD_NO_START : whole;
}

static int open_tcp(const uint8_t *bytes, size_t len, const struct md_message *request, const uint8_t **body)
{
    int whole = md_tcp_length(bytes, len);
    if (whole <= 0)
        return whole;
    size_t have = len < (size_t)whole ? len : (size_t)whole;
    int length = body_length(MD_TCP, bytes + MD_TCP_HEAD, have - MD_TCP_HEAD, request);
    if (length < 0)
        return length;
    if (length == 0 ? len >= (size_t)whole : MD_TCP_HEAD + length != whole)
        return MD_BAD_LENGTH;
    if (length == 0 || len < (size_t)whole)
        return MD_INCOMPLETE;
    *body = bytes + MD_TCP_HEAD;
    return whole;
}

/* Find the body of the frame at the beginning of `bytes`: in place, or unhexed into `text`. */
static int open_frame(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                      uint8_t text[MOST_BODY + 1], const uint8_t **body)
{
    if (framing == MD_RTU)
        return open_rtu(bytes, len, request, body);
    if (framing == MD_TCP)
        return open_tcp(bytes, len, request, body);
    *body = text;
    return open_text(framing, bytes, len, request, text);
}

static int close_frame(int framing, uint16_t transaction, uint8_t *body, size_t len, uint8_t *out,
                       size_t room)
{
    static const uint8_t digits[] = "0123456789ABCDEF";
    if (framing == MD_RTU) {
        if (room < len + 2)
            return MD_BAD_REQUEST;
        uint16_t crc = md_crc16(body, len);
        memcpy(out, body, len);
        out[len] = (uint8_t)crc;
        out[len + 1] = (uint8_t)(crc >> 8);
        return (int)len + 2;
    }
    if (framing == MD_TCP) {
        if (room < MD_TCP_HEAD + len)
            return MD_BAD_REQUEST;
        uint8_t *head = md_put16(md_put16(md_put16(out, transaction), 0), (unsigned)len);
        memcpy(head, body, len);
        return MD_TCP_HEAD + (int)len;
    }
    if (room < 2 * len + 5)
        return MD_BAD_REQUEST;
    body[len] = text_checksum(framing, body, len);
    uint8_t *at = out;
    *at++ = ':';
    for (size_t i = 0; i <= len; i++) {
        *at++ = digits[body[i] >> 4];
        *at++ = digits[body[i] & 15];
    }
    *at++ = '\r';
    *at++ = '\n';
    return (int)(at - out);
}

/* ---- what may be said ---- */

static int is_range(const struct function *function, const struct md_message *message)
{
    unsigned count = message->count;
    return count >= 1 && count <= function->most && message->start + count <= 0x10000;
}

/* Check that a body of this layout can say it. */
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
    default:
        return layout == ECHO && message->data_len == 2;
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

/* Check that the reply says what the request asked for. A write is confirmed by its own address and value,
 * or address and count. Of Delixi's (part 3, note 1) a query is answered in P1P0 or in D3..D0, and
 * everything else with a copy. */
static int confirms(int framing, const uint8_t *body, const struct md_message *request)
{
    uint16_t start = md_get16(body + 2);
    switch (find_function(framing, request->function)->reply) {
    case RANGE:
        return start == request->start && md_get16(body + 4) == request->count;
    case ECHO:
        return start == request->start && memcmp(body + 4, request->data, 2) == 0;
    case LONG: /* there is no state 0: that is the query itself */
        return (request->function == MD_DELIXI_STATE_QUERY ? start != 0 : start == request->start) &&
               (request->function == MD_DELIXI_PARAMETER_QUERY || memcmp(body + 4, request->data, 4) == 0);
    default:
        return 1;
    }
}

/* ---- the contract ---- */

int md_build_request(int framing, const struct md_message *message, uint8_t *out, size_t room)
{
    if (!is_request(framing, message))
        return MD_BAD_REQUEST;
    uint8_t body[MOST_BODY + 1] = {message->address, message->function};
    size_t len = put_body(find_function(framing, message->function)->request, message, body);
    return close_frame(framing, message->transaction, body, len, out, room);
}

int md_build_reply(int framing, const struct md_message *message, uint8_t *out, size_t room)
{
    if (!is_reply(framing, message))
        return MD_BAD_REQUEST;
    uint8_t body[MOST_BODY + 1] = {message->address, message->function};
    size_t len = EXCEPTION_BODY;
    if (!message->exception) {
        len = put_body(find_function(framing, message->function)->reply, message, body);
    } else if (framing == MD_DELIXI) { /* the rest is 0: "no meaning" */
        body[1] = message->exception;
        len = DELIXI_BODY;
    } else {
        body[1] |= EXCEPTION_BIT;
        body[2] = message->exception;
    }
    return close_frame(framing, message->transaction, body, len, out, room);
}

int md_parse_request(int framing, const uint8_t *bytes, size_t len, struct md_message *message)
{
    uint8_t text[MOST_BODY + 1];
    const uint8_t *body;
    int used = open_frame(framing, bytes, len, NULL, text, &body);
    if (used <= 0)
        return used;
    begin_message(message, body[0], body[1]);
    if (framing == MD_TCP)
        message->transaction = md_get16(bytes);
    get_body(find_function(framing, body[1])->request, body, message);
    return used;
}

int md_parse_reply(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                   struct md_message *reply)
{
    uint8_t text[MOST_BODY + 1];
    const uint8_t *body;
    int used = open_frame(framing, bytes, len, request, text, &body);
    if (used <= 0)
        return used;
    int is_exception = body[1] != request->function;
    if (!is_exception && !confirms(framing, body, request))
        return MD_BAD_ECHO;
    begin_message(reply, body[0], request->function);
    if (framing == MD_TCP)
        reply->transaction = md_get16(bytes);
    if (is_exception) {
        reply->exception = framing == MD_DELIXI ? body[1] : body[2];
        return used;
    }
    int layout = find_function(framing, body[1])->reply;
    get_body(layout, body, reply);
    if (layout == DATA) {
        reply->start = request->start;
        reply->count = request->count;
    }
    if (framing == MD_DELIXI && body[1] == MD_DELIXI_STATE_QUERY) /* as all others have it */
        md_put16(reply->data + 2, reply->start);
    return used;
}

int md_reply_length(int framing, const struct md_message *request)
{
    const struct function *function = find_function(framing, request->function);
    int data = function->reply == DATA ? (int)data_bytes(function, request->count) : 0;
    int body = head_length(function->reply) + data;
    if (!is_answered(framing, request->address))
        return 0;
    if (framing == MD_RTU)
        return body + 2;
    return framing == MD_TCP ? MD_TCP_HEAD + body : 2 * body + 5;
}

int md_is_gateways(int framing, const struct md_message *reply)
{
    return framing == MD_TCP && (reply->exception == NO_PATH || reply->exception == NO_TARGET);
}

void md_copy_message(struct md_message *to, const struct md_message *from)
{
    memcpy(to, from, offsetof(struct md_message, data) + from->data_len);
}
