/* Requests and replies in four framings: Modbus RTU, Modbus ASCII, Modbus TCP, Delixi's own ASCII
 * (serial-line guide V1.02, messaging guide for TCP/IP V1.0b). What they wrap is the body; see body.c. */
#include "internal.h"

#include <string.h>

/* ---- out of the wrapping ---- */

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
    if (len >= 4 && md_get16(bytes + 2) != 0) /* the protocol */
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

/* Find the body of the frame at the beginning of `bytes`: in place, or unhexed into `text`. */
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

/* ---- into the wrapping ---- */

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

/* ---- the contract ---- */

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

int md_reply_length(int framing, const struct md_message *request)
{
    int body = md_body_reply_length(framing, request);
    if (body == 0)
        return 0;
    if (framing == MD_RTU)
        return body + 2;
    return framing == MD_TCP ? MD_TCP_HEAD + body : 2 * body + 5;
}
