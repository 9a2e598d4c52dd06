/* Columns as recordings hold them: times of float, codes of a byte. */
#include "internal.h"

#include <string.h>

static const float BEYOND = 0x1p63F; /* the first that no int64 can be */

/* Return the next float towards plus infinity; not of zero, which is exact. */
static float next_up(float number)
{
    uint32_t bits;
    memcpy(&bits, &number, sizeof bits);
    bits += number > 0 ? 1U : UINT32_MAX;
    memcpy(&number, &bits, sizeof bits);
    return number;
}

void md_narrow_up(const int64_t *numbers, size_t n, float *out)
{
    for (size_t i = 0; i < n; i++) {
        float near = (float)numbers[i];
        out[i] = near < BEYOND && (int64_t)near < numbers[i] ? next_up(near) : near;
    }
}

int md_widen(const float *numbers, const uint8_t *valid, size_t n, int64_t *out)
{
    for (size_t i = 0; i < n; i++) {
        int is_valid = !valid || (valid[i / 8] >> (i % 8) & 1);
        if (is_valid && !(numbers[i] >= -BEYOND && numbers[i] <= BEYOND))
            return -1;
        out[i] = !is_valid ? 0 : numbers[i] < BEYOND ? (int64_t)numbers[i] : INT64_MAX;
    }
    return 0;
}

size_t md_narrow_codes(const uint16_t *codes, size_t n, const int16_t *numbers, size_t known, uint8_t *out)
{
    for (size_t i = 0; i < n; i++) {
        if (codes[i] >= known || numbers[codes[i]] < 0)
            return i;
        out[i] = (uint8_t)numbers[codes[i]];
    }
    return n;
}

void md_widen_codes(const uint8_t *codes, size_t n, uint16_t *out)
{
    for (size_t i = 0; i < n; i++)
        out[i] = codes[i];
}

uint16_t md_greatest_code(const uint16_t *codes, size_t n)
{
    uint16_t greatest = 0;
    for (size_t i = 0; i < n; i++)
        greatest = codes[i] > greatest ? codes[i] : greatest;
    return greatest;
}

size_t md_find_codes(const uint16_t *drives, const uint16_t *registers, size_t n, uint16_t drive,
                     uint16_t reg, uint32_t *places)
{
    size_t found = 0;
    for (size_t i = 0; i < n; i++)
        if (drives[i] == drive && registers[i] == reg)
            places[found++] = (uint32_t)i;
    return found;
}
