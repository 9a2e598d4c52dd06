/* A ring buffer of all bytes on a line, read as packets of a pcapng file.
 *
 * The line's thread writes, one other thread reads, and neither waits for the other. Bytes that do not fit
 * are dropped and counted. */
#include "internal.h"

#include <string.h>

/* The header of bytes in the ring buffer. */
struct mark {
    int64_t time_ns; /* CLOCK_MONOTONIC; UTC if `side` has IS_UTC */
    uint32_t len, side;
};

enum { IS_UTC = 1 << 16 }; /* flag in `side`: the time is UTC */

static uint32_t get(const uint32_t *counter)
{
    return __atomic_load_n(counter, __ATOMIC_ACQUIRE);
}

static void set(uint32_t *counter, uint32_t value)
{
    __atomic_store_n(counter, value, __ATOMIC_RELEASE);
}

/* Return the address of a position in the ring buffer. Set `first` to the number of the `len` bytes that fit
 * before the end of the buffer. */
static uint8_t *place(const struct md_tap *tap, uint32_t at, size_t len, size_t *first)
{
    uint32_t offset = at & (tap->room - 1);
    *first = len < tap->room - offset ? len : tap->room - offset;
    return tap->ring + offset;
}

static void copy_in(const struct md_tap *tap, uint32_t at, const void *from, size_t len)
{
    size_t first;
    uint8_t *to = place(tap, at, len, &first);
    memcpy(to, from, first);
    memcpy(tap->ring, (const uint8_t *)from + first, len - first);
}

static void copy_out(const struct md_tap *tap, uint32_t at, void *to, size_t len)
{
    size_t first;
    const uint8_t *from = place(tap, at, len, &first);
    memcpy(to, from, first);
    memcpy((uint8_t *)to + first, tap->ring, len - first);
}

void md_tap_put(struct md_tap *tap, int side, int64_t time_ns, const uint8_t *bytes, size_t len)
{
    if (!tap || len == 0)
        return;
    uint32_t put = tap->put, is_utc = tap->ahead_ns ? IS_UTC : 0;
    struct mark mark = {
        .time_ns = time_ns + tap->ahead_ns, .len = (uint32_t)len, .side = (uint32_t)side | is_utc};
    if (tap->room - (put - get(&tap->taken)) < sizeof mark + len) {
        __atomic_fetch_add(&tap->lost, len, __ATOMIC_RELAXED);
        return;
    }
    copy_in(tap, put, &mark, sizeof mark);
    copy_in(tap, put + (uint32_t)sizeof mark, bytes, len);
    set(&tap->put, put + (uint32_t)(sizeof mark + len));
}

static uint8_t *put32(uint8_t *at, uint32_t value)
{
    for (int i = 0; i < 4; i++)
        *at++ = (uint8_t)(value >> 8 * i);
    return at;
}

/* Write a packet's header and trailer; return the address for its bytes. */
static uint8_t *wrap(const struct md_wrapping *wrapping, uint32_t interface, int64_t time_ns, uint32_t len,
                     uint8_t *out)
{
    uint32_t packet = wrapping->head_len + len, padding = -packet & 3;
    uint32_t size = MD_PACKET_HEAD + packet + padding + wrapping->tail_len + MD_PACKET_END;
    uint64_t time = (uint64_t)time_ns;
    const uint32_t head[] = {
        MD_PACKET_BLOCK, size, interface, (uint32_t)(time >> 32), (uint32_t)time, packet, packet,
    };
    for (size_t i = 0; i < sizeof head / sizeof *head; i++)
        out = put32(out, head[i]);
    memcpy(out, wrapping->head, wrapping->head_len);
    uint8_t *bytes = out + wrapping->head_len;
    memset(bytes + len, 0, padding);
    memcpy(bytes + len + padding, wrapping->tail, wrapping->tail_len);
    put32(bytes + len + padding + wrapping->tail_len, size);
    return bytes;
}

static const struct md_wrapping *choose(const struct md_wrapping *wrappings, uint32_t side, uint8_t first)
{
    return &wrappings[2 * side + (first == ':')];
}

size_t md_packet_length(const struct md_wrapping *wrappings, int side, uint8_t first, size_t len)
{
    const struct md_wrapping *wrapping = choose(wrappings, (uint32_t)side, first);
    size_t packet = (wrapping->head_len + len + 3) & ~(size_t)3;
    return MD_PACKET_HEAD + packet + wrapping->tail_len + MD_PACKET_END;
}

void md_put_packet(const struct md_wrapping *wrappings, uint32_t interface, int side, int64_t time_ns,
                   const uint8_t *bytes, size_t len, uint8_t *out)
{
    const struct md_wrapping *wrapping = choose(wrappings, (uint32_t)side, len ? *bytes : 0);
    memcpy(wrap(wrapping, interface, time_ns, (uint32_t)len, out), bytes, len);
}

size_t md_tap_take(struct md_tap *tap, const struct md_wrapping *wrappings, uint32_t interface,
                   int64_t utc_minus_monotonic_ns, uint8_t *out, size_t room)
{
    uint32_t taken = tap->taken, put = get(&tap->put);
    size_t used = 0;
    while (taken != put) {
        struct mark mark;
        uint8_t first;
        copy_out(tap, taken, &mark, sizeof mark);
        copy_out(tap, taken + (uint32_t)sizeof mark, &first, 1);
        uint32_t side = mark.side & ~(uint32_t)IS_UTC;
        size_t size = md_packet_length(wrappings, (int)side, first, mark.len);
        if (room - used < size)
            break;
        const struct md_wrapping *wrapping = choose(wrappings, side, first);
        int64_t time_ns = mark.time_ns + (mark.side & IS_UTC ? 0 : utc_minus_monotonic_ns);
        uint8_t *bytes = wrap(wrapping, interface, time_ns, mark.len, out + used);
        copy_out(tap, taken + (uint32_t)sizeof mark, bytes, mark.len);
        used += size;
        taken += (uint32_t)(sizeof mark + mark.len);
    }
    set(&tap->taken, taken);
    return used;
}
