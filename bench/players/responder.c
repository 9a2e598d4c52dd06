/* Answers every 8-byte request immediately with 10 registers, on a new pty, whose path it prints.
 * Runs until standard input ends. */
#define _GNU_SOURCE
#include "raw_pty.h"

#include <poll.h>
#include <string.h>
#include <unistd.h>

static unsigned crc16(const unsigned char *bytes, int len)
{
    unsigned crc = 0xFFFF;
    for (int i = 0; i < len; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0xA001 : crc >> 1;
    }
    return crc;
}

int main(void)
{
    int master = announce_pty();
    unsigned char reply[25] = {1, 3, 20}, request[256];
    for (int i = 3; i < 23; i++)
        reply[i] = (unsigned char)i;
    size_t have = 0;
    struct pollfd ready[2] = {{.fd = master, .events = POLLIN}, {.fd = 0, .events = POLLIN}};
    while (poll(ready, 2, -1) > 0 && !ready[1].revents) {
        ssize_t got = read(master, request + have, sizeof request - have);
        if (got <= 0)
            return 1;
        for (have += (size_t)got; have >= 8; have -= 8) {
            reply[0] = request[0];
            unsigned crc = crc16(reply, 23);
            reply[23] = (unsigned char)crc;
            reply[24] = (unsigned char)(crc >> 8);
            if (write(master, reply, sizeof reply) != sizeof reply)
                return 1;
            memmove(request, request + 8, have - 8);
        }
    }
    return 0;
}
