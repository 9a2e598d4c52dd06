/* Requests and replies in four framings: Modbus RTU, Modbus ASCII, Modbus TCP, Delixi's ASCII (serial-line
 * guide V1.02, messaging guide for TCP/IP V1.0b). See body.c for their content. */
#include "internal.h"

#include <string.h>

/* ---- checksums ---- */

/* CRC-16/MODBUS, polynomial A001H (8005H reversed), of every byte value followed by 0 to 3 zero bytes. The
 * CRC of a byte is the XOR of the CRCs of its bits, which are the arguments of ALL. */
#define BYTE(n, a, b, c, d, e, f, g, h) \
    ((n) & 1 ? a : 0) ^ ((n) & 2 ? b : 0) ^ ((n) & 4 ? c : 0) ^ ((n) & 8 ? d : 0) ^ \
    ((n) & 16 ? e : 0) ^ ((n) & 32 ? f : 0) ^ ((n) & 64 ? g : 0) ^ ((n) & 128 ? h : 0)
#define TWO(n, ...) BYTE(n, __VA_ARGS__), BYTE(n + 1, __VA_ARGS__)
#define FOUR(n, ...) TWO(n, __VA_ARGS__), TWO(n + 2, __VA_ARGS__)
#define EIGHT(n, ...) FOUR(n, __VA_ARGS__), FOUR(n + 4, __VA_ARGS__)
#define SIXTEEN(n, ...) EIGHT(n, __VA_ARGS__), EIGHT(n + 8, __VA_ARGS__)
#define ROW(n, ...) SIXTEEN(n, __VA_ARGS__), SIXTEEN(n + 16, __VA_ARGS__)
#define QUARTER(n, ...) ROW(n, __VA_ARGS__), ROW(n + 32, __VA_ARGS__)
#define HALF(n, ...) QUARTER(n, __VA_ARGS__), QUARTER(n + 64, __VA_ARGS__)
#define ALL(...) {HALF(0, __VA_ARGS__), HALF(128, __VA_ARGS__)}

static const uint16_t crc_of[][256] = {
    ALL(0xC0C1, 0xC181, 0xC301, 0xC601, 0xCC01, 0xD801, 0xF001, 0xA001),
    ALL(0x9001, 0x6001, 0xC002, 0xC007, 0xC00D, 0xC019, 0xC031, 0xC061),
    ALL(0xC051, 0xC0A1, 0xC141, 0xC281, 0xC501, 0xCA01, 0xD401, 0xE801),
    ALL(0xFC01, 0xB801, 0x3001, 0x6002, 0xC004, 0xC00B, 0xC015, 0xC029),
};

uint16_t md_crc16(const uint8_t *bytes, size_t len)
{
    uint16_t crc = 0xFFFF;
    for (; len >= 4; bytes += 4, len -= 4)
        crc = crc_of[3][(crc ^ bytes[0]) & 0xFF] ^ crc_of[2][crc >> 8 ^ bytes[1]] ^ crc_of[1][bytes[2]] ^
              crc_of[0][bytes[3]];
    for (; len > 0; bytes++, len--)
        crc = (uint16_t)(crc >> 8 ^ crc_of[0][(crc ^ *bytes) & 0xFF]);
    return crc;
}

uint8_t md_sum(const uint8_t *bytes, size_t len)
{
    unsigned sum = 0;
    for (size_t i = 0; i < len; i++)
        sum += bytes[i];
    return (uint8_t)sum;
}

uint8_t md_lrc(const uint8_t *bytes, size_t len)
{
    return (uint8_t)-md_sum(bytes, len);
}

/* ---- parsing ---- */

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

/* Decode the hex digits in the body of a Modbus ASCII or Delixi frame; return the frame's length. */
static int open_text(int framing, const uint8_t *text, size_t len, const struct md_message *request,
                     uint8_t body[MD_MOST_BODY + 1])
{
    if (len > 0 && text[0] != ':')
        return MD_NO_START;
    size_t have = 0;
    int byte = 0;
    while (have <= MD_MOST_BODY && 2 * have + 2 < len && (byte = md_hex_byte(text + 2 * have + 1)) >= 0)
        body[have++] = (uint8_t)byte;
    int length = md_body_length(framing, body, have, request);
    if (length < 0)
        return length;
    if (length == 0 || have <= (size_t)length) /* the checksum follows the body */
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
    int length = md_body_length(MD_RTU, bytes, len, request);
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
    if (len >= 4 && md_get16(bytes + 2) != 0) /* in Modbus TCP the protocol id is always 0 */
        return MD_NO_START;
    if (len < MD_TCP_HEAD)
        return MD_INCOMPLETE;
    int whole = MD_TCP_HEAD + md_get16(bytes + 4);
    return whole < MD_TCP_HEAD + 2 || whole > MD_MOST_TCP ? MD_NO_START : whole;
}

int md_tcp_is_exception(const uint8_t *bytes, size_t len, const struct md_message *request)
{
    const uint8_t *body = bytes + MD_TCP_HEAD;
    return request && len >= MD_TCP_HEAD + 2 && md_get16(bytes + 2) == 0 && body[0] == request->address &&
           body[1] == (request->function | MD_EXCEPTION_BIT);
}

static int open_tcp(const uint8_t *bytes, size_t len, const struct md_message *request, const uint8_t **body)
{
    int whole = md_tcp_length(bytes, len);
    if (md_tcp_is_exception(bytes, len, request))
        whole = MD_TCP_EXCEPTION;
    else if (whole == MD_NO_START && request && len < MD_TCP_HEAD + 2 && !md_get16(bytes + 2))
        return MD_INCOMPLETE; /* with one more byte it may be an exception whose header has a wrong length */
    if (whole <= 0)
        return whole;
    size_t have = len < (size_t)whole ? len : (size_t)whole;
    int length = md_body_length(MD_TCP, bytes + MD_TCP_HEAD, have - MD_TCP_HEAD, request);
    if (length < 0)
        return length;
    if (length == 0 ? len >= (size_t)whole : MD_TCP_HEAD + length != whole)
        return MD_BAD_LENGTH;
    if (len < (size_t)whole)
        return MD_INCOMPLETE;
    *body = bytes + MD_TCP_HEAD;
    return whole;
}

/* Find the body of the frame at the start of `bytes`: in place, or decoded from hex digits into `text`. */
static int open_frame(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                      uint8_t text[MD_MOST_BODY + 1], const uint8_t **body)
{
    if (framing == MD_RTU)
        return open_rtu(bytes, len, request, body);
    if (framing == MD_TCP)
        return open_tcp(bytes, len, request, body);
    *body = text;
    return open_text(framing, bytes, len, request, text);
}

/* ---- building ---- */

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

/* ---- requests and replies ---- */

int md_build_request(int framing, const struct md_message *message, uint8_t *out, size_t room)
{
    uint8_t body[MD_MOST_BODY + 1] = {message->address, message->function};
    int len = md_body_put_request(framing, message, body);
    return len < 0 ? len : close_frame(framing, message->transaction, body, (size_t)len, out, room);
}

int md_build_reply(int framing, const struct md_message *message, uint8_t *out, size_t room)
{
    uint8_t body[MD_MOST_BODY + 1] = {message->address, message->function};
    int len = md_body_put_reply(framing, message, body);
    return len < 0 ? len : close_frame(framing, message->transaction, body, (size_t)len, out, room);
}

int md_parse_request(int framing, const uint8_t *bytes, size_t len, struct md_message *message)
{
    uint8_t text[MD_MOST_BODY + 1];
    const uint8_t *body;
    int used = open_frame(framing, bytes, len, NULL, text, &body);
    if (used <= 0)
        return used;
    md_body_get_request(framing, body, message);
    if (framing == MD_TCP)
        message->transaction = md_get16(bytes);
    return used;
}

int md_parse_reply(int framing, const uint8_t *bytes, size_t len, const struct md_message *request,
                   struct md_message *reply)
{
    uint8_t text[MD_MOST_BODY + 1];
    const uint8_t *body;
    int used = open_frame(framing, bytes, len, request, text, &body);
    if (used <= 0)
        return used;
    if (!md_body_get_reply(framing, body, request, reply))
        return MD_BAD_ECHO;
    if (framing == MD_TCP)
        reply->transaction = md_get16(bytes);
    return used;
}

static int frame_length(int framing, int body)
{
    if (body == 0)
        return 0;
    if (framing == MD_RTU)
        return body + 2;
    return framing == MD_TCP ? MD_TCP_HEAD + body : 2 * body + 5;
}

int md_reply_length(int framing, const struct md_message *request)
{
    return frame_length(framing, md_body_reply_length(framing, request));
}

int md_longest_reply(int framing, const struct md_message *request)
{
    return frame_length(framing, md_body_longest_reply(framing, request));
}

/* ---- why a request has no reply ---- */

/* Return the offset at which the next frame may start: the next byte, or with Modbus TCP the end of this
 * frame. After a damaged Modbus TCP header the offset is unknown; then return `len`. */
static size_t next_at(int framing, const uint8_t *bytes, size_t len)
{
    int whole = framing == MD_TCP ? md_tcp_length(bytes, len) : 1;
    return whole > 0 ? (size_t)whole : len;
}

/* Return the most specific reason; among equally specific ones, the first. The search continues inside a
 * frame from another address: the expected frame may start there. */
int md_reason(int framing, const struct md_message *request, const uint8_t *bytes, size_t len)
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
    struct md_message reply;
    if (len == 0)
        return MD_NO_REPLY;
    int reason = MD_INCOMPLETE;
    for (size_t at = 0; at < len; at += next_at(framing, bytes + at, len - at)) {
        int why = md_parse_reply(framing, bytes + at, len - at, request, &reply);
        if (why > 0) {
            if (md_is_from_gateway(framing, &reply))
                return MD_NO_REPLY;
            continue;
        }
        if (why == MD_INCOMPLETE)
            why = MD_CUT_SHORT;
        if (weights[-why] > weights[-reason])
            reason = why;
    }
    return reason;
}
