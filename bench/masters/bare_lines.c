/* The baseline for many lines: a client that does the minimum. It writes, waits with epoll and reads, one
 * exchange at a time on each line, and checks only the reply's length. Prints the results as JSON. */
#define _GNU_SOURCE
#include "multidrop.h"

#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/resource.h>
#include <time.h>
#include <unistd.h>

enum { REQUEST = 8, REPLY = 25, MOST_DRIVES = 16, EVENTS = 256 };

struct line {
    int fd, have;
    unsigned turn;
};

static uint8_t requests[MOST_DRIVES][REQUEST];

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static double cpu_seconds(void)
{
    struct rusage used;
    getrusage(RUSAGE_SELF, &used);
    return (double)(used.ru_utime.tv_sec + used.ru_stime.tv_sec) +
           (double)(used.ru_utime.tv_usec + used.ru_stime.tv_usec) / 1e6;
}

static void make_requests(void)
{
    for (int i = 0; i < MOST_DRIVES; i++) {
        memcpy(requests[i], (uint8_t[]){(uint8_t)(i + 1), 3, 0, 0, 0, 10}, 6);
        uint16_t crc = md_crc16(requests[i], 6);
        requests[i][6] = (uint8_t)crc;
        requests[i][7] = (uint8_t)(crc >> 8);
    }
}

static void ask(struct line *line)
{
    line->have = 0;
    if (write(line->fd, requests[line->turn++ % MOST_DRIVES], REQUEST) != REQUEST)
        exit(1);
}

int main(int argc, char **argv)
{
    if (argc < 3) {
        fprintf(stderr,
                "usage: bare_lines SECONDS LINE... (a line is an inherited descriptor or a pty's path)\n");
        return 2;
    }
    int count = argc - 2, epoll = epoll_create1(0);
    struct line *lines = calloc((size_t)count, sizeof *lines);
    if (!lines || epoll < 0)
        return 1;
    make_requests();
    for (int i = 0; i < count; i++) {
        const char *name = argv[2 + i];
        lines[i].fd = name[0] == '/' ? open(name, O_RDWR | O_NOCTTY) : atoi(name);
        struct epoll_event event = {.events = EPOLLIN, .data.ptr = &lines[i]};
        if (fcntl(lines[i].fd, F_SETFL, O_NONBLOCK) || epoll_ctl(epoll, EPOLL_CTL_ADD, lines[i].fd, &event)) {
            perror(name);
            return 1;
        }
        ask(&lines[i]);
    }
    long good = 0;
    double cpu = cpu_seconds();
    int64_t begun = now_ns(), end = begun + (int64_t)(strtod(argv[1], NULL) * 1e9), now;
    struct epoll_event events[EVENTS];
    uint8_t reply[256];
    while ((now = now_ns()) < end) {
        int n = epoll_wait(epoll, events, EVENTS, 1000);
        for (int i = 0; i < n; i++) {
            struct line *line = events[i].data.ptr;
            ssize_t got = read(line->fd, reply, sizeof reply);
            if (got <= 0)
                continue;
            line->have += (int)got;
            if (line->have >= REPLY) {
                good++;
                ask(line);
            }
        }
    }
    printf("{\"exchanges\": %ld, \"failures\": 0, \"cpu_seconds\": %.6f, \"seconds\": %.6f}\n", good,
           cpu_seconds() - cpu,
           (double)(now - begun) / 1e9);
    return 0;
}
