/* Shared by the C fuzz harnesses: assertions, and the position of frames or noise in an input.
 *
 * A harness defines LLVMFuzzerTestOneInput and find_wire. mutator.c mutates inputs and repairs the frame at
 * the position that find_wire returns: otherwise most mutated frames would have wrong byte counts and
 * checksums. */
#ifndef FUZZ_H
#define FUZZ_H

#include "line.h"

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define must(truth) \
    ((truth) ? (void)0 : (fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #truth), abort()))

/* The position of bytes in an input that the harness passes to the core as bytes from a line. */
struct wire {
    size_t at, len;
    size_t length_at;           /* position of the input's byte with `len`; SIZE_MAX: none */
    int is_fixed;               /* `len` must not change */
    int framing;                /* -1: any */
    int is_reply;               /* the bytes should be a reply to `request` */
    struct md_message request;
};

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* Select bytes from a line in the input, depending on `seed`; return 0 if there are none. May repair bytes
 * around them, such as lengths. */
int find_wire(uint8_t *data, size_t size, unsigned seed, struct wire *wire);

/* Return a copy in memory of exactly this size, so that sanitizers detect over-reads. The caller frees it. */
static inline uint8_t *exact_copy(const uint8_t *bytes, size_t len)
{
    uint8_t *copy = malloc(len ? len : 1);
    if (!copy)
        abort();
    return len ? memcpy(copy, bytes, len) : copy;
}

/* A request in an input: framing, address, function, start, count, and the first two bytes of its data. */
enum { REQUEST_BYTES = 9 };

static inline int framing_of(uint8_t byte)
{
    return byte % 16 == 15 ? MD_TCP : byte % 3;
}

static inline struct md_message request_of(const uint8_t bytes[REQUEST_BYTES])
{
    struct md_message request = {
        .address = bytes[1],
        .function = bytes[2],
        .start = (uint16_t)(bytes[3] << 8 | bytes[4]),
        .count = (uint16_t)(bytes[5] << 8 | bytes[6]),
        .data = {bytes[7], bytes[8]},
    };
    switch (request.function) {
    case 0x05: case 0x06: case 0x08: request.data_len = 2; break;
    case 0x0F: request.data_len = (uint16_t)((request.count + 7) / 8 % 251); break;
    case 0x10: request.data_len = (uint16_t)(2 * request.count % 251); break;
    case 0x16: request.data_len = 4; break;
    case 0x2B:
        request.data_len = 3;
        request.data[2] = request.data[1];
        request.data[1] = request.data[0];
        request.data[0] = 0x0E; /* device identification */
        break;
    default: break;
    }
    if (framing_of(bytes[0]) == MD_DELIXI)
        request.data_len = 4;
    return request;
}

#endif
