/* Plays the drives on any number of lines in one thread. Replies are scheduled, so that many lines need
 * little CPU time.
 *
 * Each register's value is 256 * address + register, and 128 more for function 04. A reply comes immediately,
 * or when it would be complete on a wire of --baudrate. Some replies are late by up to --late-us, some are
 * lost, and some come twice. All replies of a line come --path-us later, in order. Replies due in the first
 * --stall-us of each --stall-every-us are delayed until the stall's end. Lines are inherited descriptors, or
 * new ptys, whose paths are printed. Runs until standard input ends, then prints counts as JSON. */
#define _GNU_SOURCE
#include "multidrop.h"
#include "raw_pty.h"

#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

enum { REQUEST = 8, MOST_REPLY = 256, EVENTS = 256, CHARACTER_BITS = 10 };

static struct {
    long baudrate, delay_us, late_us, late_permille, lost_permille, twice_permille, ptys, path_us, stall_us,
        stall_every_us;
} options;

struct line {
    int fd;
    int64_t last_due_ns; /* due time of the last reply: a path keeps the order of replies */
    size_t have;
    uint8_t received[256];
};

/* Pending replies are in a heap, whose element 0 is due first. */
struct reply {
    int64_t due_ns, last_ns; /* time to send the reply; time after which it counts as lost */
    int fd;
    uint16_t len;
    uint8_t bytes[MOST_REPLY];
};

static struct reply *due;
static size_t on_their_way, room;
static int64_t character_ns;
static long requests, refused, late, lost, twice;

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

/* ---- the heap ---- */

static void swap(size_t a, size_t b)
{
    struct reply kept = due[a];
    due[a] = due[b];
    due[b] = kept;
}

static void push(const struct reply *reply)
{
    if (on_their_way == room) {
        room = room ? 2 * room : 64;
        due = realloc(due, room * sizeof *due);
        if (!due)
            abort();
    }
    due[on_their_way] = *reply;
    for (size_t at = on_their_way++; at && due[at].due_ns < due[(at - 1) / 2].due_ns; at = (at - 1) / 2)
        swap(at, (at - 1) / 2);
}

static void drop_first(void)
{
    due[0] = due[--on_their_way];
    for (size_t at = 0, child; (child = 2 * at + 1) < on_their_way; at = child) {
        if (child + 1 < on_their_way && due[child + 1].due_ns < due[child].due_ns)
            child++;
        if (due[at].due_ns <= due[child].due_ns)
            break;
        swap(at, child);
    }
}

/* ---- the drives ---- */

static void hand_over(const struct reply *reply)
{
    if (options.late_us && now_ns() > reply->last_ns) {
        lost++;
        return;
    }
    (void)!write(reply->fd, reply->bytes, reply->len); /* ignore errors: the client may have ended */
}

static int happens(long permille)
{
    return permille && rand() % 1000 < permille;
}

static void make_reply(struct reply *reply, const uint8_t *request)
{
    unsigned start = (unsigned)request[2] << 8 | request[3], count = request[5] > 125 ? 125 : request[5];
    unsigned first = 256u * request[0] + start + (request[1] == 4 ? 128 : 0);
    reply->bytes[0] = request[0];
    reply->bytes[1] = request[1];
    reply->bytes[2] = (uint8_t)(2 * count);
    for (unsigned i = 0; i < count; i++) {
        reply->bytes[3 + 2 * i] = (uint8_t)((first + i) >> 8);
        reply->bytes[4 + 2 * i] = (uint8_t)(first + i);
    }
    reply->len = (uint16_t)(5 + 2 * count);
    uint16_t crc = md_crc16(reply->bytes, 3 + 2 * count);
    reply->bytes[reply->len - 2] = (uint8_t)crc;
    reply->bytes[reply->len - 1] = (uint8_t)(crc >> 8);
}

/* Return when bytes that enter the line's path at `at_ns` leave it, after its delay and stalls. */
static int64_t through_path(struct line *line, int64_t at_ns)
{
    int64_t due_ns = at_ns + options.path_us * 1000;
    if (options.stall_every_us) {
        int64_t since_ns = at_ns % (options.stall_every_us * 1000);
        if (since_ns < options.stall_us * 1000)
            due_ns += options.stall_us * 1000 - since_ns;
    }
    if (due_ns <= line->last_due_ns) /* make times distinct: the heap may reorder equal times */
        due_ns = line->last_due_ns + 1;
    line->last_due_ns = due_ns;
    return due_ns;
}

static void answer(struct line *line, const uint8_t *request, int64_t came_ns)
{
    struct reply reply = {.fd = line->fd};
    requests++;
    make_reply(&reply, request);
    if (happens(options.lost_permille)) {
        lost++;
        return;
    }
    if (happens(options.twice_permille) && reply.len <= MOST_REPLY / 2) {
        twice++;
        memcpy(reply.bytes + reply.len, reply.bytes, reply.len); /* the copy follows directly, as on a wire */
        reply.len = (uint16_t)(2 * reply.len);
    }
    reply.due_ns = came_ns + (REQUEST + reply.len) * character_ns + options.delay_us * 1000;
    reply.last_ns = reply.due_ns + options.late_us * 1000;
    if (happens(options.late_permille)) {
        late++;
        reply.due_ns += rand() % (options.late_us + 1) * 1000;
    }
    if (options.path_us || options.stall_us)
        reply.due_ns = through_path(line, reply.due_ns);
    if (reply.due_ns > came_ns)
        push(&reply);
    else
        hand_over(&reply);
}

static void hear(struct line *line)
{
    ssize_t got = read(line->fd, line->received + line->have, sizeof line->received - line->have);
    if (got <= 0)
        return;
    int64_t came_ns = character_ns || options.late_us || options.path_us || options.stall_us ? now_ns() : 0;
    size_t at = 0;
    for (line->have += (size_t)got; line->have - at >= REQUEST; at += REQUEST) {
        if (md_crc16(line->received + at, REQUEST)) {
            refused++;
            at = line->have;
            break;
        }
        answer(line, line->received + at, came_ns);
    }
    line->have -= at;
    memmove(line->received, line->received + at, line->have);
}

/* ---- lines ---- */

static void watch(int epoll, int fd, struct line *line)
{
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = line};
    fcntl(fd, F_SETFL, O_NONBLOCK);
    if (line)
        *line = (struct line){.fd = fd};
    if (epoll_ctl(epoll, EPOLL_CTL_ADD, fd, &event)) {
        perror("responders");
        exit(1);
    }
}

static void play(int epoll)
{
    struct epoll_event events[EVENTS];
    for (;;) {
        int64_t left = on_their_way ? due[0].due_ns - now_ns() : 0;
        struct timespec span = {.tv_sec = left / 1000000000, .tv_nsec = left % 1000000000};
        if (left < 0)
            span = (struct timespec){0};
        int n = epoll_pwait2(epoll, events, EVENTS, on_their_way ? &span : NULL, NULL);
        for (int64_t now = now_ns(); on_their_way && due[0].due_ns <= now; drop_first())
            hand_over(&due[0]);
        for (int i = 0; i < n; i++) {
            if (!events[i].data.ptr)
                return;
            hear(events[i].data.ptr);
        }
    }
}

static void read_options(int argc, char **argv)
{
    static const struct option known[] = {
        {"baudrate", 1, NULL, 'b'}, {"delay-us", 1, NULL, 'd'}, {"late-us", 1, NULL, 'l'}, {"late-permille",
                                                            1, NULL, 'm'},
        {"lost-permille", 1, NULL, 'o'}, {"twice-permille", 1, NULL, 't'}, {"ptys", 1, NULL, 'p'}, {"path-us",
                                                            1, NULL, 'P'},
        {"stall-us", 1, NULL, 's'}, {"stall-every-us", 1, NULL, 'e'}, {NULL, 0, NULL, 0}};
    int key;
    while ((key = getopt_long(argc, argv, "", known, NULL)) != -1) {
        long number = optarg ? strtol(optarg, NULL, 10) : 0;
        switch (key) {
        case 'b': options.baudrate = number; break;
        case 'd': options.delay_us = number; break;
        case 'l': options.late_us = number; break;
        case 'm': options.late_permille = number; break;
        case 'o': options.lost_permille = number; break;
        case 't': options.twice_permille = number; break;
        case 'p': options.ptys = number; break;
        case 'P': options.path_us = number; break;
        case 's': options.stall_us = number; break;
        case 'e': options.stall_every_us = number; break;
        default:
            fprintf(stderr,
                    "usage: responders [--baudrate N (0: no waits)] [--delay-us N] [--late-us N] [--late-permille N]\n"
                            "       [--lost-permille N] [--twice-permille N] [--ptys N] [--path-us N]\n"
                            "       [--stall-us N --stall-every-us N] [DESCRIPTOR ...]\n");
            exit(2);
        }
    }
    character_ns = options.baudrate ? CHARACTER_BITS * INT64_C(1000000000) / options.baudrate : 0;
}

int main(int argc, char **argv)
{
    read_options(argc, argv);
    size_t inherited = (size_t)(argc - optind), count = (size_t)options.ptys + inherited;
    struct line *lines = calloc(count + 1, sizeof *lines);
    int epoll = epoll_create1(0);
    if (!lines || epoll < 0)
        return 1;
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    for (size_t i = 0; i < inherited; i++)
        watch(epoll, atoi(argv[optind + (int)i]), &lines[i]);
    for (size_t i = inherited; i < count; i++) {
        int fd = open_raw_pty();
        watch(epoll, fd, &lines[i]);
        printf("%s ", ptsname(fd));
    }
    printf("\n");
    fflush(stdout);
    watch(epoll, 0, NULL);
    play(epoll);
    printf("{\"requests\": %ld, \"refused\": %ld, \"late\": %ld, \"lost\": %ld, \"twice\": %ld}\n", requests,
           refused, late,
           lost, twice);
    return 0;
}
