/* Realtime scheduling of the calling thread. Such a thread runs as soon as it is ready, before all normal
 * threads of the computer. Two limits keep it from starving them:
 *
 * - md_realtime_check() returns the thread to normal scheduling if it used more than half of a processor.
 * - If the thread runs for MOST_CPU_NS without a check, because the core hangs, a kernel timer ends the
 *   process with SIGXCPU. */
#define _GNU_SOURCE
#include "internal.h"

#include <errno.h>

#ifdef __linux__

#include <link.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <sys/mman.h>

enum {
    PRIORITY = 1,    /* the lowest of SCHED_FIFO, so that the threads of drivers come first */
    STACK = 64 << 10 /* bytes of the thread's stack to lock in memory */
};
static const int64_t CHECK_NS = 500000000; /* ns; time between two checks of the thread's CPU time */
/* This limit is long, because a virtual machine's pause may count as the thread's CPU time. */
static const int64_t MOST_CPU_NS = 10000000000;

/* ---- memory ---- */

typedef int change_function(const void *from, size_t len); /* mlock or munlock */

static int is_loaded(const ElfW(Phdr) *segment)
{
    return segment->p_type == PT_LOAD;
}

/* If this loaded object is the core, lock or unlock its segments. The core is the object that contains the
 * constant CHECK_NS. */
static int change_own(struct dl_phdr_info *object, size_t size, void *argument)
{
    change_function **change = argument;
    const ElfW(Phdr) *segments = object->dlpi_phdr;
    int is_own = 0;
    (void)size;
    for (int i = 0; i < object->dlpi_phnum; i++)
        is_own |= is_loaded(&segments[i]) && (uintptr_t)&CHECK_NS - object->dlpi_addr - segments[i].p_vaddr <
                                                 segments[i].p_memsz;
    for (int i = 0; is_own && i < object->dlpi_phnum; i++)
        if (is_loaded(&segments[i]))
            (*change)((const void *)(uintptr_t)(object->dlpi_addr + segments[i].p_vaddr),
                      segments[i].p_memsz);
    return is_own;
}

/* Lock or unlock the core's code and the thread's stack, as far as RLIMIT_MEMLOCK permits. The data of lines
 * are used at each exchange, so the system hardly ever swaps them out. */
static void change_memory(change_function *change)
{
    char top;
    dl_iterate_phdr(change_own, &change);
    change((const void *)((uintptr_t)&top - STACK), STACK);
}

/* ---- scheduling ---- */

static int64_t used_ns(void)
{
    return md_clock_ns(CLOCK_THREAD_CPUTIME_ID);
}

/* With SCHED_RESET_ON_FORK, threads and processes that this thread starts get normal scheduling. */
static int schedule(int policy, int priority)
{
    struct sched_param parameters = {.sched_priority = priority};
    return -pthread_setschedparam(pthread_self(), policy | SCHED_RESET_ON_FORK, &parameters);
}

/* Set the kernel's timer, which runs by the thread's CPU time. */
static void set_timer(const struct md_realtime *realtime)
{
    struct itimerspec end = {.it_value = timespec_of(realtime->used_ns + MOST_CPU_NS)};
    timer_settime(realtime->timer, TIMER_ABSTIME, &end, NULL);
}

static void note_check(struct md_realtime *realtime, int64_t now_ns)
{
    realtime->checked_ns = now_ns;
    realtime->used_ns = used_ns();
    set_timer(realtime);
}

int md_realtime_start(struct md_realtime *realtime)
{
    struct sigevent end = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGXCPU};
    if (realtime->is_on)
        return 0;
    if (timer_create(CLOCK_THREAD_CPUTIME_ID, &end, &realtime->timer))
        return -errno;
    note_check(realtime, md_now_ns());
    int failure = schedule(SCHED_FIFO, PRIORITY);
    if (failure)
        timer_delete(realtime->timer);
    else
        change_memory(mlock);
    realtime->is_on = !failure;
    return failure;
}

void md_realtime_end(struct md_realtime *realtime)
{
    if (!realtime->is_on)
        return;
    schedule(SCHED_OTHER, 0);
    timer_delete(realtime->timer);
    change_memory(munlock);
    realtime->is_on = 0;
}

void md_realtime_check(struct md_realtime *realtime, int64_t now_ns)
{
    int64_t passed_ns = now_ns - realtime->checked_ns;
    if (!realtime->is_on || passed_ns < CHECK_NS)
        return;
    if (2 * (used_ns() - realtime->used_ns) > passed_ns)
        md_realtime_end(realtime);
    else
        note_check(realtime, now_ns);
}

#elif defined _WIN32

/* No limit is needed: Windows' multimedia class scheduler leaves a fifth of the CPU time to other threads. */
#include <windows.h>

#include <avrt.h>

int md_realtime_start(struct md_realtime *realtime)
{
    DWORD index = 0;
    if (!realtime->is_on)
        realtime->task = AvSetMmThreadCharacteristicsW(L"Pro Audio", &index);
    realtime->is_on = realtime->task != NULL;
    return realtime->is_on ? 0 : -EPERM;
}

void md_realtime_end(struct md_realtime *realtime)
{
    if (realtime->is_on)
        AvRevertMmThreadCharacteristics(realtime->task);
    realtime->is_on = 0;
}

void md_realtime_check(struct md_realtime *realtime, int64_t now_ns)
{
    (void)realtime, (void)now_ns;
}

#else

int md_realtime_start(struct md_realtime *realtime)
{
    (void)realtime;
    return -ENOSYS;
}

void md_realtime_end(struct md_realtime *realtime)
{
    (void)realtime;
}

void md_realtime_check(struct md_realtime *realtime, int64_t now_ns)
{
    (void)realtime, (void)now_ns;
}

#endif
