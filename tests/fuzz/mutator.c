/* The mutator of all C harnesses: mutate an input, then repair lengths, byte counts and checksums of frames.
 *
 * Otherwise a receiver would reject nearly all mutated frames at its first checks.
 * Sometimes it leaves one field wrong, to test the handling of a frame with a single mistake. */
#include "fuzz.h"

enum { MOST_BODY = 260 }; /* slightly more than any frame's body */

size_t LLVMFuzzerMutate(uint8_t *data, size_t size, size_t most);
size_t LLVMFuzzerCustomMutator(uint8_t *data, size_t size, size_t most, unsigned seed);

/* Return a pseudo-random number less than `below`. */
static unsigned draw(unsigned *seed, unsigned below)
{
    *seed = *seed * 1664525u + 1013904223u;
    return (*seed >> 16) % below;
}

static int is_rare(unsigned *seed)
{
    return draw(seed, 16) == 0;
}

static int hex_digit(uint8_t character)
{
    return character >= '0' && character <= '9' ? character - '0'
           : character >= 'A' && character <= 'F' ? character - 'A' + 10 : -1;
}

/* Extract the body (address, function, data) from a frame in any framing; return its length. */
static size_t take_body(const uint8_t *bytes, size_t len, int framing, uint8_t body[MOST_BODY])
{
    size_t have = 0;
    memset(body, 0, MOST_BODY);
    if (framing == MD_TCP) {
        size_t head = len < MD_TCP_HEAD ? len : MD_TCP_HEAD;
        bytes += head;
        len -= head;
    }
    if (framing == MD_RTU || framing == MD_TCP || len == 0 || bytes[0] != ':') {
        have = len > MOST_BODY - 2 ? MOST_BODY - 2 : len;
        if (have)
            memcpy(body, bytes, have);
        return have >= 2 && framing == MD_RTU ? have - 2 : have;
    }
    for (size_t at = 1; at + 1 < len && have < MOST_BODY - 2; at += 2) {
        int high = hex_digit(bytes[at]), low = hex_digit(bytes[at + 1]);
        if (high < 0 || low < 0)
            break;
        body[have++] = (uint8_t)(high << 4 | low);
    }
    return have ? have - 1 : 0;
}

static void put16(uint8_t *at, unsigned value)
{
    at[0] = (uint8_t)(value >> 8);
    at[1] = (uint8_t)value;
}

/* Repair the count and byte count in a request's body; return its length, which depends on the function. */
static size_t mend_request(uint8_t *body, size_t have)
{
    if (body[1] != 0x0F && body[1] != 0x10)
        return 6;
    size_t data = have > 7 ? have - 7 : 2;
    if (body[1] == 0x10)
        data += data % 2;
    body[6] = (uint8_t)data;
    put16(body + 4, (unsigned)(body[1] == 0x10 ? data / 2 : 8 * data));
    return 7 + data;
}

/* Repair a reply's body; return its length. If the request is known, repair the fields that repeat it too. */
static size_t mend_reply(uint8_t *body, size_t have, const struct md_message *request)
{
    if (body[1] & 0x80) {
        body[2] |= !body[2];
        return 3;
    }
    if (body[1] > 0x04) {
        if (request)
            put16(body + 2, request->start);
        if (request && body[1] < 0x0F)
            memcpy(body + 4, request->data, 2);
        else if (request)
            put16(body + 4, request->count);
        return 6;
    }
    unsigned unit = body[1] > 0x02 ? 16 : 1;
    size_t data = have > 3 ? have - 3 : 2;
    if (request)
        data = (request->count * unit + 7) / 8;
    else if (unit == 16)
        data += data % 2;
    body[2] = (uint8_t)data;
    return 3 + data < MOST_BODY - 2 ? 3 + data : MOST_BODY - 2;
}

static size_t mend_modbus(uint8_t *body, size_t have, const struct wire *wire, unsigned *seed)
{
    static const uint8_t functions[] = {1, 2, 3, 4, 5, 6, 8, 0x0F, 0x10};
    const struct md_message *request = wire->is_reply ? &wire->request : NULL;
    if (request && !is_rare(seed))
        body[0] = request->address;
    if (request && !is_rare(seed))
        body[1] = draw(seed, 6) ? request->function : request->function | 0x80;
    if (!request && !is_rare(seed) && !memchr(functions, body[1] & 0x7F, sizeof functions))
        body[1] = functions[draw(seed, sizeof functions)];
    if (!request && !is_rare(seed))
        body[0] &= 0x0F;
    size_t len = request || body[1] & 0x80 || draw(seed, 2) ? mend_reply(body, have, request)
        : mend_request(body, have);
    return is_rare(seed) && len > 1 ? len - 1 : len;
}

static size_t mend_delixi(uint8_t *body, const struct wire *wire, unsigned *seed)
{
    static const uint8_t refusals[] = {0xF0, 0xFC, 0xFD, 0xFE, 0xFF};
    if (wire->is_reply) {
        const struct md_message *request = &wire->request;
        body[0] = request->address;
        body[1] = draw(seed, 6) ? request->function : refusals[draw(seed, sizeof refusals)];
        if (request->function != 0x03)
            put16(body + 2, request->start);
        if (request->function != 0x07 && !is_rare(seed))
            memcpy(body + 4, request->data, 4);
    } else if (!is_rare(seed)) {
        body[0] &= 0x0F;
        body[1] = (uint8_t)(2 + body[1] % 6);
        if (draw(seed, 2))
            memset(body + 4, 0, 4);
    }
    return 8;
}

static uint8_t sum_of(const uint8_t *body, size_t len)
{
    unsigned sum = 0;
    for (size_t i = 0; i < len; i++)
        sum += body[i];
    return (uint8_t)sum;
}

/* CRC-16 by the bitwise algorithm of the Modbus serial-line guide, independent of the core. */
static uint16_t crc_of(const uint8_t *body, size_t len)
{
    unsigned crc = 0xFFFF;
    for (size_t i = 0; i < len; i++) {
        crc ^= body[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0xA001 : crc >> 1;
    }
    return (uint16_t)crc;
}

static size_t close_frame(int framing, uint8_t *body, size_t len, uint8_t *frame)
{
    static const char digits[] = "0123456789ABCDEF";
    if (framing == MD_RTU) {
        uint16_t crc = crc_of(body, len);
        memcpy(frame, body, len);
        frame[len] = (uint8_t)crc;
        frame[len + 1] = (uint8_t)(crc >> 8);
        return len + 2;
    }
    if (framing == MD_TCP) {
        put16(frame + 2, 0);
        put16(frame + 4, (unsigned)len);
        memcpy(frame + MD_TCP_HEAD, body, len);
        return MD_TCP_HEAD + len;
    }
    body[len] = framing == MD_ASCII ? (uint8_t)-sum_of(body, len) : sum_of(body, len);
    uint8_t *at = frame;
    *at++ = ':';
    for (size_t i = 0; i <= len; i++) {
        *at++ = (uint8_t)digits[body[i] >> 4];
        *at++ = (uint8_t)digits[body[i] & 15];
    }
    *at++ = '\r';
    *at++ = '\n';
    return (size_t)(at - frame);
}

/* Replace the bytes at `wire` by the frame, if there is room; return the input's new size. */
static size_t replace(uint8_t *data, size_t size, size_t most, const struct wire *wire,
                      const uint8_t *frame, size_t len)
{
    size_t behind = size - wire->at - wire->len;
    if ((wire->is_fixed && len != wire->len) || size - wire->len + len > most ||
        (wire->length_at != SIZE_MAX && len > 255))
        return size;
    memmove(data + wire->at + len, data + wire->at + wire->len, behind);
    memcpy(data + wire->at, frame, len);
    if (wire->length_at != SIZE_MAX)
        data[wire->length_at] = (uint8_t)len;
    return wire->at + len + behind;
}

static size_t repair(uint8_t *data, size_t size, size_t most, unsigned seed)
{
    struct wire wire = {.length_at = SIZE_MAX, .framing = -1};
    uint8_t body[MOST_BODY + 2], frame[2 * MOST_BODY + 8];
    if (!find_wire(data, size, seed, &wire))
        return size;
    int framing = wire.framing;
    if (framing < 0 && wire.len && data[wire.at] == ':')
        framing = draw(&seed, 2) ? MD_ASCII : MD_DELIXI;
    if (framing < 0)
        framing = draw(&seed, 6) ? MD_RTU : draw(&seed, 2) ? MD_ASCII : MD_DELIXI;
    size_t junk = draw(&seed, 8) || framing == MD_TCP ? 0 : draw(&seed, 4); /* bytes before the frame */
    if (junk < wire.len && !wire.is_fixed) { /* keep these bytes */
        wire.at += junk;
        wire.len -= junk;
    } else
        junk = 0;
    size_t have = take_body(data + wire.at, wire.len, framing, body);
    size_t len = framing == MD_DELIXI ? mend_delixi(body, &wire, &seed)
        : mend_modbus(body, have, &wire, &seed);
    len = close_frame(framing, body, len, frame);
    if (framing == MD_TCP) /* keep the transaction id */
        put16(frame, wire.len < 2 ? 0 : md_get16(data + wire.at));
    if (is_rare(&seed))
        frame[draw(&seed, (unsigned)len)] ^= (uint8_t)(1u << draw(&seed, 8));
    size_t grown = replace(data, size, most, &wire, frame, len);
    if (junk && wire.length_at != SIZE_MAX && grown != size)
        data[wire.length_at] = (uint8_t)(len + junk);
    return grown;
}

size_t LLVMFuzzerCustomMutator(uint8_t *data, size_t size, size_t most, unsigned seed)
{
    size = LLVMFuzzerMutate(data, size, most);
    for (unsigned rounds = draw(&seed, 4); rounds > 0; rounds--)
        size = repair(data, size, most, seed = seed * 69069u + rounds);
    return size;
}
