/* Plays drives of different families on one line at the pace of a real wire.
 *
 * Each argument is a drive: ADDRESS:FRAMING:BAUDRATE:CHARACTER_NS:DELAY_NS:SILENCE_NS. It receives only
 * requests at its own baud rate, and answers every read. Each byte of a reply is written when its last bit
 * would have arrived. Plays on a new pty, whose path it prints, until standard input ends. Then it prints
 * the requests and their times as JSON. */
#define _GNU_SOURCE
#include "multidrop.h"
#include "raw_pty.h"

#include <errno.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

enum { MOST_DRIVES = 247 };

static const int64_t TOLERANCE_NS = 20000; /* a request that is early by less does not count as too early */
static const int64_t SPIN_NS = 80000;      /* spin for this time before a deadline, instead of sleeping */

struct drive {
    int address, framing;
    unsigned baudrate;
    int64_t character_ns, delay_ns, silence_ns;
    long answered;
};

static struct drive drives[MOST_DRIVES];
static int count;

static struct {
    long requests, early, refused, cycles; /* a cycle ends when the first request comes again */
    struct md_message first;
    int64_t first_ns, last_ns, cycles_ns;
    int64_t exchange_ns; /* least time of the latest exchange, without silence */
    int64_t ideal_ns;    /* sum of the earlier exchanges' least times, with silences */
} seen;

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void wait_until(int64_t deadline_ns)
{
    int64_t wake_ns = deadline_ns - SPIN_NS;
    if (wake_ns > now_ns()) {
        struct timespec until = {.tv_sec = wake_ns / 1000000000, .tv_nsec = wake_ns % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
            ;
    }
    while (now_ns() < deadline_ns)
        ;
}

/* ---- the drives ---- */

static unsigned baudrate_of(int fd)
{
    struct md_settings settings;
    return md_port_get(fd, &settings) ? 0 : settings.baudrate;
}

/* Return the drive to which the frame at the start of `bytes` is addressed; `used` is its length. */
static struct drive *asked(int fd, const uint8_t *bytes, size_t len, struct md_message *request, int *used)
{
    unsigned baudrate = baudrate_of(fd);
    for (int i = 0; i < count; i++) {
        struct drive *drive = &drives[i];
        if (drive->baudrate != baudrate)
            continue;
        *request = (struct md_message){0};
        *used = md_parse_request(drive->framing, bytes, len, request);
        if (*used > 0 && request->address == drive->address)
            return drive;
    }
    return NULL;
}

static int make_reply(const struct drive *drive, const struct md_message *request, uint8_t *out, size_t room)
{
    struct md_message reply = {.address = request->address, .function = request->function,
                               .start = request->start};
    int bits = request->function == 1 || request->function == 2;
    if (drive->framing == MD_DELIXI && request->function == 3)
        reply.start = 1; /* 0 is not a state of a drive */
    reply.data_len = (uint16_t)(drive->framing == MD_DELIXI ? 4 : bits ? (request->count + 7) / 8
                                : 2 * request->count);
    return md_build_reply(drive->framing, &reply, out, room);
}

/* Send the reply; return the time from which the line is silent again. */
static int64_t answer(int fd, struct drive *drive, const struct md_message *request, int64_t end_ns)
{
    uint8_t reply[MD_MOST_FRAME];
    int len = make_reply(drive, request, reply, sizeof reply);
    if (len < 0) {
        seen.refused++;
        return end_ns;
    }
    int64_t now = end_ns;
    for (int sent = 0; sent < len; sent++) {
        wait_until(end_ns + drive->delay_ns + (sent + 1) * drive->character_ns);
        now = now_ns();
        if (write(fd, reply + sent, 1) != 1)
            exit(1);
    }
    seen.exchange_ns = drive->delay_ns + len * drive->character_ns;
    drive->answered++;
    return now;
}

/* ---- the line ---- */

/* Count a request that came at came_ns. The line was silent since quiet_ns; silence_ns was required. */
static void note(const struct md_message *request, int64_t came_ns, int64_t quiet_ns, int64_t silence_ns)
{
    if (seen.requests++ == 0) {
        seen.first = *request;
        seen.first_ns = seen.last_ns = came_ns;
        return;
    }
    seen.early += came_ns < quiet_ns + silence_ns - TOLERANCE_NS;
    seen.ideal_ns += seen.exchange_ns + silence_ns;
    seen.last_ns = came_ns;
    if (memcmp(request, &seen.first, sizeof *request) == 0) {
        seen.cycles++;
        seen.cycles_ns = came_ns - seen.first_ns;
    }
}

static void play(int fd)
{
    uint8_t bytes[1024];
    size_t have = 0;
    int64_t quiet_ns = 0, silence_ns = 0;
    struct pollfd ready[2] = {{.fd = fd, .events = POLLIN}, {.fd = 0, .events = POLLIN}};
    while (poll(ready, 2, -1) > 0 && !ready[1].revents) {
        ssize_t got = read(fd, bytes + have, sizeof bytes - have);
        int64_t came_ns = now_ns();
        if (got <= 0)
            continue;
        have += (size_t)got;
        struct md_message request = {0};
        int used = 0;
        struct drive *drive = asked(fd, bytes, have, &request, &used);
        if (!drive) {
            seen.refused += have == sizeof bytes;
            have = have == sizeof bytes ? 0 : have;
            continue;
        }
        if (silence_ns < drive->silence_ns)
            silence_ns = drive->silence_ns;
        note(&request, came_ns, quiet_ns, silence_ns);
        seen.exchange_ns = 0;
        quiet_ns = answer(fd, drive, &request, came_ns + used * drive->character_ns);
        seen.exchange_ns += used * drive->character_ns;
        silence_ns = drive->silence_ns;
        have = 0;
    }
}

int main(int argc, char **argv)
{
    for (int i = 1; i < argc && count < MOST_DRIVES; i++) {
        struct drive *drive = &drives[count++];
        long long character_ns, delay_ns, silence_ns;
        if (sscanf(argv[i], "%d:%d:%u:%lld:%lld:%lld", &drive->address, &drive->framing, &drive->baudrate,
                   &character_ns,
                   &delay_ns, &silence_ns) != 6) {
            fprintf(stderr,
                    "usage: mixed_line ADDRESS:FRAMING:BAUDRATE:CHARACTER_NS:DELAY_NS:SILENCE_NS ...\n");
            return 2;
        }
        drive->character_ns = character_ns;
        drive->delay_ns = delay_ns;
        drive->silence_ns = silence_ns;
    }
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    play(announce_pty());
    double span_ns = (double)(seen.last_ns - seen.first_ns);
    printf("{\"requests\": %ld, \"early\": %ld, \"refused\": %ld, \"utilisation\": %.5f, \"cycles\": %ld, \"cycle_ms\": %.4f, ",
           seen.requests, seen.early, seen.refused, span_ns > 0 ? (double)seen.ideal_ns / span_ns : 0,
               seen.cycles,
           seen.cycles ? (double)seen.cycles_ns / (double)seen.cycles / 1e6 : 0);
    printf("\"answered\": {");
    for (int i = 0; i < count; i++)
        printf("%s\"%d\": %ld", i ? ", " : "", drives[i].address, drives[i].answered);
    printf("}}\n");
    return 0;
}
