/* Plays a line of Modbus RTU drives at the pace of a real wire.
 *
 * Plays addresses 1..N on a new pty, whose path it prints, until standard input ends. Then it prints numbers
 * and times of requests as JSON. A request occupies the wire for the time of its characters, from its arrival
 * here. Each byte of a reply is written at the time when its last bit would arrive. */
#define _GNU_SOURCE
#include "raw_pty.h"
#include <arpa/inet.h>
#include <errno.h>
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
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { MOST_DRIVES = 247, REQUEST = 8 };

static const int64_t TOLERANCE_NS = 20000; /* a request that is early by less does not count as too early */
static const int64_t SPIN_NS = 80000;      /* spin for this time before a deadline, instead of sleeping */
static const int64_t STALE_NS = 50000000;  /* a request that takes longer to arrive is discarded */

static struct {
    long baudrate, bits, drives, registers, delay_us, settle_ms; /* baudrate 0: no waits at all */
    int stray, whole, tcp, realtime;
    char silent[MOST_DRIVES + 1];
} options = {.baudrate = 38400, .bits = 10, .drives = 16, .registers = 10, .delay_us = 2000};

static int64_t character_ns, silence_ns, delay_ns;

/* ---- measurements ---- */

struct samples {
    int64_t *at;
    size_t n, room;
};

static struct samples lateness, excess;
static int64_t settled_ns, first_ns, last_ns; /* times: start of counting, first and last counted request */
static int64_t pending_ideal_ns, ideal_ns;
static long answered, unanswered, early, given_up, refused, registers, per_drive[MOST_DRIVES + 1];
static int is_crossed; /* the next request came before the reply was complete */

static void add(struct samples *samples, int64_t sample)
{
    if (samples->n == samples->room) {
        samples->room = samples->room ? 2 * samples->room : 1 << 16;
        samples->at = realloc(samples->at, samples->room * sizeof *samples->at);
        if (!samples->at)
            abort();
    }
    samples->at[samples->n++] = sample;
}

static int ascending(const void *a, const void *b)
{
    int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

static void print_percentiles(const char *name, struct samples *samples)
{
    size_t n = samples->n;
    if (n)
        qsort(samples->at, n, sizeof *samples->at, ascending);
    static const struct {
        const char *name;
        size_t permille;
    } wanted[] = {{"p1", 10}, {"p50", 500}, {"p99", 990}, {"max", 1000}};
    printf("\"%s\": {", name);
    for (int i = 0; i < 4; i++) {
        size_t at = wanted[i].permille * (n ? n - 1 : 0) / 1000;
        printf("%s\"%s\": %.1f", i ? ", " : "", wanted[i].name, n ? (double)samples->at[at] / 1e3 : 0);
    }
    printf("}");
}

static void print_report(void)
{
    long drives = 0, counted = 0;
    printf("{\"exchanges\": {");
    for (long i = 1; i <= options.drives; i++)
        if (per_drive[i]) {
            printf("%s\"%ld\": %ld", drives++ ? ", " : "", i, per_drive[i]);
            counted += per_drive[i];
        }
    double span = (double)(last_ns - first_ns), ideal = (double)ideal_ns;
    double cycles = drives ? (double)counted / (double)drives : 1;
    printf("}, \"seconds\": %.3f, \"answered\": %ld, \"unanswered\": %ld, ", span / 1e9, answered, unanswered);
    printf("\"early\": %ld, \"given_up\": %ld, \"refused\": %ld, \"registers\": %ld, ", early, given_up, refused,
           registers);
    printf("\"ideal_cycle_ms\": %.4f, \"cycle_ms\": %.4f, \"utilisation\": %.5f, ", ideal / cycles / 1e6,
           span / cycles / 1e6, span > 0 ? ideal / span : 0);
    print_percentiles("lateness_us", &lateness);
    printf(", ");
    print_percentiles("excess_us", &excess);
    printf("}\n");
}

/* ---- time ---- */

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static struct timespec timespec_of(int64_t ns)
{
    return (struct timespec){.tv_sec = ns / 1000000000, .tv_nsec = ns % 1000000000};
}

static void wait_until(int64_t deadline_ns)
{
    if (deadline_ns - SPIN_NS > now_ns()) {
        struct timespec until = timespec_of(deadline_ns - SPIN_NS);
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
            ;
    }
    while (now_ns() < deadline_ns)
        ;
}

/* ---- the drives ---- */

static uint16_t crc16(const uint8_t *bytes, size_t len)
{
    unsigned crc = 0xFFFF;
    for (size_t i = 0; i < len; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0xA001 : crc >> 1;
    }
    return (uint16_t)crc;
}

/* Build the reply to FC03: register r of address a is 256 * a + r. A missing register gives an exception. */
static size_t make_reply(const uint8_t *request, uint8_t *out)
{
    unsigned start = (unsigned)(request[2] << 8 | request[3]),
        count = (unsigned)(request[4] << 8 | request[5]);
    size_t len = 0;
    if (options.stray)
        *out++ = 0x00;
    out[len++] = request[0];
    if (request[1] != 3 || !count || count > 125 || start + count > (unsigned)options.registers) {
        refused++;
        out[len++] = (uint8_t)(request[1] | 0x80);
        out[len++] = request[1] == 3 ? 2 : 1;
    } else {
        registers += count;
        out[len++] = 3;
        out[len++] = (uint8_t)(2 * count);
        for (unsigned i = start; i < start + count; i++) {
            out[len++] = request[0];
            out[len++] = (uint8_t)i;
        }
    }
    uint16_t crc = crc16(out, len);
    out[len++] = (uint8_t)crc;
    out[len++] = (uint8_t)(crc >> 8);
    return len + (options.stray ? 1 : 0);
}

static int has_request(int fd)
{
    struct pollfd ready = {.fd = fd, .events = POLLIN};
    return poll(&ready, 1, 0) > 0;
}

/* Send the reply; return the time at which the last byte was written. */
static int64_t send_reply(int fd, const uint8_t *reply, size_t len, int64_t begin_ns)
{
    size_t step = options.whole || !character_ns ? len : 1;
    int64_t now = 0;
    for (size_t sent = 0; sent < len; sent += step) {
        int64_t deadline = begin_ns + (int64_t)(sent + step) * character_ns;
        wait_until(deadline);
        is_crossed |= sent + step >= len && has_request(fd);
        now = now_ns();
        if (write(fd, reply + sent, step) != (ssize_t)step)
            exit(1);
        if (character_ns)
            add(&lateness, now - deadline);
    }
    return now;
}

/* Answer a request that came at begun_ns (`has_next`: the next request has come too). Return the time from
 * which the line is silent. */
static int64_t answer(int fd, const uint8_t *request, int64_t begun_ns, int64_t quiet_ns, int has_next)
{
    uint8_t reply[300];
    int64_t end_ns = begun_ns + REQUEST * character_ns;
    if (!settled_ns)
        settled_ns = begun_ns + options.settle_ms * 1000000;
    int counts = begun_ns >= settled_ns;
    if (counts) {
        first_ns = first_ns ? first_ns : begun_ns;
        last_ns = begun_ns;
        ideal_ns += pending_ideal_ns;
        pending_ideal_ns = 0;
        if (quiet_ns && character_ns) {
            int is_early = begun_ns < quiet_ns + silence_ns - TOLERANCE_NS;
            early += is_early;
            given_up += is_early && is_crossed; /* the master did not wait for the previous reply */
            add(&excess, begun_ns - quiet_ns - silence_ns);
        }
    }
    is_crossed = has_next;
    if (request[0] < 1 || request[0] > options.drives || options.silent[request[0]]) {
        unanswered += counts;
        return end_ns;
    }
    size_t len = make_reply(request, reply);
    if (counts) {
        answered++;
        per_drive[request[0]]++;
        pending_ideal_ns = (REQUEST + (int64_t)len) * character_ns + delay_ns + silence_ns;
    }
    return send_reply(fd, reply, len, end_ns + delay_ns);
}

/* ---- port ---- */

static int open_tcp(void)
{
    struct sockaddr_in at = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t len = sizeof at;
    int yes = 1, listener = socket(AF_INET, SOCK_STREAM, 0);
    if (bind(listener, (struct sockaddr *)&at, sizeof at) || listen(listener, 1) ||
        getsockname(listener, (struct sockaddr *)&at, &len))
        exit(1);
    printf("socket://127.0.0.1:%d\n", ntohs(at.sin_port));
    fflush(stdout);
    struct pollfd ready[2] = {{.fd = listener, .events = POLLIN}, {.fd = 0, .events = POLLIN}};
    if (poll(ready, 2, -1) < 0 || ready[1].revents)
        exit(1);
    int fd = accept4(listener, NULL, NULL, SOCK_NONBLOCK);
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    return fd;
}

/* Read bytes and the time of their arrival; return 0 when standard input or the client has ended. Sleeps
 * until bytes come: spinning could block the kernel's worker thread that carries a pty's bytes. So a request
 * is noticed about 30 us late, like a reply at the master. */
static ssize_t hear(int fd, uint8_t *bytes, size_t room, int64_t *came_ns)
{
    struct pollfd ready[2] = {{.fd = fd, .events = POLLIN}, {.fd = 0, .events = POLLIN}};
    while (poll(ready, 2, -1) > 0 && !ready[1].revents) {
        ssize_t got = read(fd, bytes, room);
        *came_ns = now_ns();
        if (got >= 0 || errno != EAGAIN)
            return got;
    }
    return 0;
}

static void play(int fd)
{
    uint8_t received[256];
    size_t have = 0;
    int64_t begun_ns = 0, came_ns, quiet_ns = 0;
    ssize_t got;
    while ((got = hear(fd, received + have, sizeof received - have, &came_ns)) > 0) {
        if (have && came_ns - begun_ns > STALE_NS) {
            memmove(received, received + have, (size_t)got);
            have = 0;
        }
        begun_ns = have ? begun_ns : came_ns;
        for (have += (size_t)got; have >= REQUEST; have -= REQUEST) {
            if (crc16(received, REQUEST)) {
                refused++;
                have = 0;
                break;
            }
            quiet_ns = answer(fd, received, begun_ns, quiet_ns, have > REQUEST);
            memmove(received, received + REQUEST, have - REQUEST);
            begun_ns = came_ns;
        }
    }
}

/* ---- arguments ---- */

static void read_options(int argc, char **argv)
{
    static const struct option known[] = {
        {"baudrate", 1, NULL, 'b'}, {"bits", 1, NULL, 'c'}, {"drives", 1, NULL, 'n'}, {"registers", 1, NULL,
                                                            'r'},
        {"delay-us", 1, NULL, 'd'}, {"silent", 1, NULL, 's'}, {"settle-ms", 1, NULL, 'w'}, {"stray", 0, NULL,
                                                            'y'},
        {"whole", 0, NULL, 'o'}, {"bytewise", 0, NULL, 'e'}, {"tcp", 0, NULL, 't'}, {"realtime", 0, NULL, 'p'}, {NULL, 0, NULL, 0}};
    int key;
    while ((key = getopt_long(argc, argv, "", known, NULL)) != -1) {
        long number = optarg ? strtol(optarg, NULL, 10) : 0;
        switch (key) {
        case 'b': options.baudrate = number; break;
        case 'c': options.bits = number; break;
        case 'n': options.drives = number; break;
        case 'r': options.registers = number; break;
        case 'd': options.delay_us = number; break;
        case 'w': options.settle_ms = number; break;
        case 'y': options.stray = 1; break;
        case 'o': options.whole = 1; break;
        case 'e': options.whole = 0; break;
        case 't': options.tcp = 1; break;
        case 'p': options.realtime = 1; break;
        case 's':
            for (char *at = strtok(optarg, ","); at; at = strtok(NULL, ",")) {
                number = strtol(at, NULL, 10);
                if (number > 0 && number <= MOST_DRIVES)
                    options.silent[number] = 1;
            }
            break;
        default:
            fprintf(stderr,
                    "usage: paced_line [--baudrate N (0: no waits)] [--bits N] [--drives N] [--registers N]\n"
                    "       [--delay-us N] [--silent A,B,...] [--settle-ms N] [--stray] [--whole|--bytewise] [--tcp]\n"
                    "       [--realtime (keep the pace beside busy programs)]\n");
            exit(2);
        }
    }
    if (options.drives < 1 || options.drives > MOST_DRIVES || options.registers < 1 ||
        options.registers > 256 ||
        options.baudrate < 0) {
        fprintf(stderr, "paced_line: 1 to %d drives, 1 to 256 registers, a baud rate of 0 or more\n",
                MOST_DRIVES);
        exit(2);
    }
}

int main(int argc, char **argv)
{
    read_options(argc, argv);
    if (options.baudrate) {
        character_ns = options.bits * 1000000000 / options.baudrate;
        /* Modbus serial-line guide, 2.5.1.1 */
        silence_ns = options.baudrate > 19200 ? 1750000 : character_ns * 7 / 2;
        delay_ns = options.delay_us * 1000;
    }
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    struct sched_param priority = {.sched_priority = 10};
    if (options.realtime && sched_setscheduler(0, SCHED_RR, &priority)) {
        perror("paced_line: SCHED_RR");
        return 1;
    }
    play(options.tcp ? open_tcp() : announce_pty());
    print_report();
    return 0;
}
