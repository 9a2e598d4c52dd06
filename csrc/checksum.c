/* The three checksums of the five families. */
#include "multidrop.h"

/* CRC of each byte value, polynomial A001H (8005H reversed); four bits a step keep it short. */
static const uint16_t crc_of_nibble[16] = {
    0x0000, 0xCC01, 0xD801, 0x1400, 0xF001, 0x3C00, 0x2800, 0xE401,
    0xA001, 0x6C00, 0x7800, 0xB401, 0x5000, 0x9C01, 0x8801, 0x4400,
};

uint16_t md_crc16(const uint8_t *bytes, size_t len)
{
    uint16_t crc = 0xFFFF;
    for (size_t i = 0; i < len; i++) {
        crc = (uint16_t)(crc ^ bytes[i]);
        crc = (uint16_t)((crc >> 4) ^ crc_of_nibble[crc & 15]);
        crc = (uint16_t)((crc >> 4) ^ crc_of_nibble[crc & 15]);
    }
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
