/* The core sends requests only while the process is master of the line: it checks CLOCK_BOOTTIME right before
 * each write(2). This test replaces the clock and write(2); the engine, its thread and the kernel's timer are
 * real. */
#define _GNU_SOURCE
#include <signal.h>
#include <stdint.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

static int told_clock(clockid_t clock, struct timespec *now);
static int made_timer(clockid_t clock, struct sigevent *event, timer_t *timer);
static ssize_t noted_write(int fd, const void *bytes, size_t len);
#define clock_gettime told_clock
#define timer_create made_timer
#define write noted_write
#include "mastership.c"
#undef timer_create
#undef clock_gettime
#include "rs485.c"
#undef write
#define send send_request /* the included file's static send() would clash with the system's */
#include "port.c"
#undef send

#include <assert.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdatomic.h>
#include <string.h>
#include <sys/socket.h>

enum { REQUEST = 8, MS = 1000000 };
static const int64_t BEGIN_NS = INT64_C(5000) * MD_SECOND_NS; /* start of the test's clock */

static _Atomic int64_t boottime_ns;
static atomic_int looks, looks_written, written, most_written;
static _Atomic int64_t passes_ns; /* how far the test's clock advances in each write */

static int told_clock(clockid_t clock, struct timespec *now)
{
    assert(clock == CLOCK_BOOTTIME);
    atomic_fetch_add(&looks, 1);
    *now = timespec_of(atomic_load(&boottime_ns));
    return 0;
}

/* The timer must use CLOCK_BOOTTIME: other clocks stop while the machine sleeps, and would kill too late. */
static int made_timer(clockid_t clock, struct sigevent *event, timer_t *timer)
{
    assert(clock == CLOCK_BOOTTIME);
    assert(event->sigev_notify == SIGEV_SIGNAL && event->sigev_signo == SIGKILL);
    return timer_create(clock, event, timer);
}

/* Take at most most_written bytes; the core must check the deadline before each call. */
static ssize_t noted_write(int fd, const void *bytes, size_t len)
{
    size_t most = (size_t)atomic_load(&most_written);
    ssize_t taken = write(fd, bytes, len < most ? len : most);
    atomic_store(&looks_written, atomic_load(&looks));
    atomic_fetch_add(&written, (int)taken);
    atomic_fetch_add(&boottime_ns, atomic_load(&passes_ns));
    return taken;
}

static struct md_history history, other_history;
static struct md_drive drive = {.least_timeout_ns = 5 * MS, .most_timeout_ns = 5 * MS, .history = &history};
static struct md_drive other = {.least_timeout_ns = 5 * MS, .most_timeout_ns = 5 * MS,
                               .history = &other_history};
static struct md_exchange reading = {.drive = &drive, .character_ns = 100000, .silence_ns = 4,
                                     .framing = MD_RTU};
static struct md_exchange stop;
static struct md_port *port;
static struct md_mastership *mastership;
static int ends[2];

static struct md_completion carry_out(const struct md_exchange *exchange)
{
    struct md_completion found;
    md_engine_enter(port->engine);
    drive.owed_count = 0; /* otherwise late replies would delay the next request */
    drive.late_until_ns = 0;
    md_engine_leave(port->engine);
    atomic_store(&written, 0);
    md_port_carry_out(port, exchange, 0, 0, &found, NULL);
    return found;
}

static void make(void)
{
    reading.request = (struct md_message){.address = 1, .function = 3, .start = 1, .count = 1};
    stop = reading;
    stop.drive = &other; /* so that a late reply to the stop cannot delay `reading` */
    stop.insists = 1;
    atomic_store(&boottime_ns, BEGIN_NS);
    atomic_store(&most_written, 1000);
    int made = socketpair(AF_UNIX, SOCK_STREAM, 0, ends);
    assert(made == 0);
    fcntl(ends[0], F_SETFL, O_NONBLOCK);
    struct md_engine *engine = md_engine_start();
    assert(engine);
    port = md_port_open(engine, ends[0], -1, MD_NO_TRANSACTIONS, 4);
    assert(port);
}

static void check_costs_nothing_without_one(void)
{
    struct md_completion found = carry_out(&reading);
    assert(found.result == MD_NO_REPLY && found.sent_ns && atomic_load(&written) == REQUEST);
    assert(atomic_load(&looks) == 0);
}

static void check_unsent(const struct md_exchange *exchange)
{
    uint32_t failures = drive.failures;
    struct md_completion found = carry_out(exchange);
    assert(found.result == MD_NOT_MASTER && found.sent_ns == 0 && atomic_load(&written) == 0);
    assert(drive.failures == failures); /* an unsent request is not a failure of the drive */
}

static int64_t left_of_timer(void)
{
    struct itimerspec left;
    timer_gettime(mastership->timer, &left);
    return left.it_value.tv_sec * MD_SECOND_NS + left.it_value.tv_nsec;
}

static int64_t real_boottime_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_BOOTTIME, &now);
    return now.tv_sec * MD_SECOND_NS + now.tv_nsec;
}

/* Extend the mastership by `ns` of the test's clock. The kernel's timer uses the real clock. It is set to an
 * hour, so that it never fires. */
static void extend(int64_t ns)
{
    int64_t kill_ns = real_boottime_ns() + 3600 * MD_SECOND_NS;
    int failed = md_mastership_extend(mastership, atomic_load(&boottime_ns) + ns, kill_ns);
    assert(!failed && left_of_timer() > 3590 * MD_SECOND_NS);
}

static void check_sent(const struct md_exchange *exchange)
{
    int before = atomic_load(&looks);
    struct md_completion found = carry_out(exchange);
    assert(found.result == MD_NO_REPLY && found.sent_ns && atomic_load(&written) == REQUEST);
    assert(atomic_load(&looks_written) > before);
}

static void check_listens_no_more(void)
{
    struct md_completion found;
    int tries = 0;
    do /* repeat, because a busy machine may delay an exchange by as much as listening does */
        found = carry_out(&reading);
    while (found.sent_ns - found.begun_ns >= 30 * MS && tries++ < 20);
    assert(found.sent_ns - found.begun_ns < 30 * MS);
}

/* A new master listens for 256 characters of 0.1 ms, and 5 ms, before its first request. */
static void check_listens_first(void)
{
    struct md_completion found = carry_out(&reading);
    assert(found.sent_ns - found.begun_ns >= 30 * MS && atomic_load(&written) == REQUEST);
    check_listens_no_more();
}

/* Listen again after a gap in mastership, even if no request was made in the gap: another process may have
 * been master meanwhile. */
static void check_listens_after_a_lapse(void)
{
    extend(1000);
    atomic_fetch_add(&boottime_ns, 1000);
    extend(1000);
    check_listens_first();
    md_mastership_end(mastership);
    extend(1000);
    check_listens_first();
    extend(2000); /* the mastership is extended before it ends: no gap */
    check_listens_no_more();
}

/* Wait for guard_ns before the first request, because the previous master may still send during that time. */
static void check_guard_comes_first(void)
{
    md_mastership_end(mastership);
    check_unsent(&reading);
    mastership->guard_ns = 200 * MS;
    extend(1000);
    struct md_completion found = carry_out(&reading);
    assert(found.sent_ns - found.begun_ns >= 200 * MS && atomic_load(&written) == REQUEST);
    mastership->guard_ns = 0;
}

static void check_deadline(void)
{
    extend(1000);
    check_sent(&reading);
    atomic_fetch_add(&boottime_ns, 999);
    check_sent(&reading);
    atomic_fetch_add(&boottime_ns, 1);
    check_unsent(&reading);
    check_unsent(&stop);
}

/* If the mastership ends after a part of a request was written, the rest is not written. */
static void check_rest_is_held_back(void)
{
    extend(1000);
    check_listens_first();
    atomic_store(&most_written, 3);
    check_sent(&reading);
    atomic_store(&passes_ns, 1000);
    struct md_completion found = carry_out(&reading);
    assert(found.result == MD_NOT_MASTER && found.sent_ns && atomic_load(&written) == 3);
    atomic_store(&passes_ns, 0);
    atomic_store(&most_written, 1000);
}

/* ---- another master sends on the line ---- */

static void check_all_foreign_bytes_are_counted(void)
{
    struct md_line line = {.listen_ns = 5};
    md_listen_receive(&line, 3, 10);
    md_listen_receive(&line, 4, 20);
    assert(line.foreign == 7 && line.listened_ns == 25);
    line.transactions = 1; /* on a network, bytes may be late replies to this process */
    md_listen_receive(&line, 3, 30);
    assert(line.foreign == 7 && line.listened_ns == 25);
}

static atomic_int is_babbling;

static void *babble(void *argument)
{
    (void)argument;
    while (atomic_load(&is_babbling)) {
        ssize_t put = write(ends[1], "\x01\x03\x02", 3);
        assert(put == 3);
        usleep(2000);
    }
    return NULL;
}

static void *read_meanwhile(void *argument)
{
    struct md_completion *found = argument;
    md_port_carry_out(port, &reading, 0, 0, found, NULL);
    return NULL;
}

static int is_listening(void)
{
    md_engine_enter(port->engine);
    int listens = port->turn.line.listened_ns != 0;
    md_engine_leave(port->engine);
    return listens;
}

static void check_other_master(void)
{
    pthread_t other, reader;
    struct md_completion found, stopped;
    extend(MD_SECOND_NS);
    reading.character_ns = 2 * MS; /* so that `reading` listens for half a second */
    atomic_store(&is_babbling, 1);
    pthread_create(&other, NULL, babble, NULL);
    found = carry_out(&reading);
    assert(found.result == MD_OTHER_MASTER && found.sent_ns == 0 && atomic_load(&written) == 0);
    assert(found.raw_len > 0 && md_port_progress(port)->foreign > 0);
    stopped = carry_out(&stop); /* a stop does not listen */
    assert(stopped.sent_ns && stopped.sent_ns - stopped.begun_ns < 300 * MS);
    assert(atomic_load(&written) == REQUEST);
    found = carry_out(&reading);
    assert(found.result == MD_OTHER_MASTER);
    atomic_store(&is_babbling, 0);
    pthread_join(other, NULL);
    uint8_t rest[256];
    while (recv(ends[1], rest, sizeof rest, MSG_DONTWAIT) > 0)
        ;
    check_sent(&reading); /* the other master is silent now */

    /* a stop is sent while `reading` still listens; `reading` is sent after that */
    md_mastership_end(mastership);
    check_unsent(&reading);
    extend(MD_SECOND_NS);
    pthread_create(&reader, NULL, read_meanwhile, &found);
    while (!is_listening())
        usleep(100);
    int64_t called_ns = md_now_ns();
    stopped = carry_out(&stop);
    pthread_join(reader, NULL);
    assert(stopped.sent_ns && stopped.sent_ns - called_ns < 300 * MS);
    assert(found.sent_ns && found.sent_ns - stopped.sent_ns > 200 * MS);
    reading.character_ns = 100000;
}

int main(void)
{
    alarm(60);
    make();
    check_costs_nothing_without_one();
    mastership = md_mastership_new(0);
    assert(mastership);
    md_port_fence(port, mastership);
    check_unsent(&reading); /* the process was never master */
    check_unsent(&stop);
    extend(1000);
    check_sent(&stop);
    check_listens_first();
    md_port_fence(port, mastership); /* after a new fence, the port must listen again */
    check_listens_first();
    check_listens_after_a_lapse();
    check_guard_comes_first();
    check_deadline();
    check_rest_is_held_back();
    check_all_foreign_bytes_are_counted();
    check_other_master();
    md_mastership_end(mastership);
    assert(left_of_timer() == 0 && md_mastership_until_ns(mastership) == 0);
    check_unsent(&stop);

    md_port_stop(port);
    md_port_free(port, NULL);
    md_mastership_free(mastership);
    close(ends[0]);
    close(ends[1]);
    return 0;
}
