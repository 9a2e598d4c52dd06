/* The three checksums of the five families. */
#include "internal.h"

/* CRC-16/MODBUS, polynomial A001H (8005H reversed), of every byte value that 0 to 3 zero bytes
 * follow: the CRC of a byte is the sum, without carry, of the CRCs of its bits, which stand below. */
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

static const uint16_t crc_of[4][256] = {
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
