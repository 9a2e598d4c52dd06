/* The baseline for one line: a master that does the minimum. It writes a request, reads the reply with
 * poll(2), checks only its length, and keeps the silence. Prints the results as JSON. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { MOST_DRIVES = 247, REQUEST = 8 };

static const int64_t TIMEOUT_NS = 300000000;

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void wait_until(int64_t deadline_ns, int64_t spin_ns)
{
    int64_t wake = deadline_ns - spin_ns;
    if (wake > now_ns()) {
        struct timespec until = {.tv_sec = wake / 1000000000, .tv_nsec = wake % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
            ;
    }
    while (now_ns() < deadline_ns)
        ;
}

static double cpu_seconds(void)
{
    struct rusage used;
    getrusage(RUSAGE_SELF, &used);
    return (double)(used.ru_utime.tv_sec + used.ru_stime.tv_sec) +
           (double)(used.ru_utime.tv_usec + used.ru_stime.tv_usec) / 1e6;
}

static void make_request(uint8_t *request, uint8_t address, uint8_t registers)
{
    unsigned crc = 0xFFFF;
    memcpy(request, (uint8_t[]){address, 3, 0, 0, 0, registers}, 6);
    for (int i = 0; i < 6; i++) {
        crc ^= request[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0xA001 : crc >> 1;
    }
    request[6] = (uint8_t)crc;
    request[7] = (uint8_t)(crc >> 8);
}

static int open_tcp(int port)
{
    struct sockaddr_in at = {
        .sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK), .sin_port = htons((uint16_t)port)};
    int yes = 1, fd = socket(AF_INET, SOCK_STREAM, 0);
    if (connect(fd, (struct sockaddr *)&at, sizeof at))
        return -1;
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    fcntl(fd, F_SETFL, O_NONBLOCK);
    return fd;
}

static int open_line(const char *path)
{
    int port;
    if (sscanf(path, "socket://127.0.0.1:%d", &port) == 1)
        return open_tcp(port);
    int fd = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK);
    struct termios raw;
    if (fd < 0 || tcgetattr(fd, &raw))
        return -1;
    cfmakeraw(&raw);
    tcsetattr(fd, TCSANOW, &raw);
    return fd;
}

/* Send a request; return 1 if a reply of `expected` bytes comes in time. First sleep for `asleep_ns`. */
static int exchange(int fd, const uint8_t *request, size_t expected, int64_t asleep_ns)
{
    uint8_t reply[256];
    if (write(fd, request, REQUEST) != REQUEST)
        return 0;
    if (asleep_ns)
        wait_until(now_ns() + asleep_ns, 0);
    for (size_t have = 0; have < expected;) {
        struct pollfd ready = {.fd = fd, .events = POLLIN};
        struct timespec timeout = {.tv_nsec = TIMEOUT_NS};
        if (ppoll(&ready, 1, &timeout, NULL) != 1)
            return 0;
        ssize_t got = read(fd, reply + have, sizeof reply - have);
        if (got <= 0)
            return 0;
        have += (size_t)got;
    }
    return 1;
}

int main(int argc, char **argv)
{
    static const struct option known[] = {
        {"seconds", 1, NULL, 's'},    {"drives", 1, NULL, 'n'},  {"registers", 1, NULL, 'r'},
        {"silence-us", 1, NULL, 'q'}, {"spin-us", 1, NULL, 'p'}, {"asleep-us", 1, NULL, 'a'},
        {"realtime", 0, NULL, 't'},   {NULL, 0, NULL, 0}};
    struct sched_param priority = {.sched_priority = 1}; /* as multidrop's core */
    double seconds = 3, silence_us = 0, spin_us = 60, asleep_us = 0; /* silence_us 0: no silence */
    int drives = 16, registers = 10, is_realtime = 0, key;
    while ((key = getopt_long(argc, argv, "", known, NULL)) != -1) {
        double number = optarg ? strtod(optarg, NULL) : 0;
        switch (key) {
        case 's': seconds = number; break;
        case 'n': drives = (int)number; break;
        case 'r': registers = (int)number; break;
        case 'q': silence_us = number; break;
        case 'p': spin_us = number; break;
        case 'a': asleep_us = number; break;
        case 't': is_realtime = 1; break;
        default: optind = argc;
        }
    }
    if (optind >= argc || drives < 1 || drives > MOST_DRIVES || registers < 1 || registers > 125) {
        fprintf(stderr,
                "usage: bare_master [--seconds S] [--drives N] [--registers N] [--silence-us N (0: unpaced)]"
                        " [--spin-us N] [--asleep-us N (after a request)] [--realtime] PORT\n");
        return 2;
    }
    int fd = open_line(argv[optind]);
    if (fd < 0) {
        perror(argv[optind]);
        return 1;
    }
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    if (is_realtime && sched_setscheduler(0, SCHED_FIFO, &priority)) {
        perror("bare_master: SCHED_FIFO");
        return 1;
    }

    uint8_t requests[MOST_DRIVES][REQUEST];
    for (int i = 0; i < drives; i++)
        make_request(requests[i], (uint8_t)(i + 1), (uint8_t)registers);
    int64_t silence_ns = (int64_t)(silence_us * 1e3), spin_ns = (int64_t)(spin_us * 1e3);
    int64_t asleep_ns = (int64_t)(asleep_us * 1e3);
    int64_t begun = now_ns(), end = begun + (int64_t)(seconds * 1e9), now;
    double cpu = cpu_seconds();
    long good = 0, bad = 0;
    do {
        int read_well = exchange(fd, requests[(good + bad) % drives], (size_t)(5 + 2 * registers), asleep_ns);
        good += read_well;
        bad += !read_well;
        now = now_ns();
        if (silence_ns)
            wait_until(now + silence_ns, spin_ns);
    } while (now < end);
    printf("{\"exchanges\": %ld, \"failures\": %ld, \"cpu_seconds\": %.6f, \"seconds\": %.6f}\n", good, bad,
           cpu_seconds() - cpu, (double)(now - begun) / 1e9);
    return 0;
}
