/* Realtime scheduling returns to normal if a thread uses too much of a processor, and a thread that hangs
 * ends the process. */
#include "realtime.c"

#include <assert.h>
#include <stdio.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

/* musl's sched_getscheduler() always fails. */
static long policy(void)
{
    return syscall(SYS_sched_getscheduler, 0) & ~SCHED_RESET_ON_FORK;
}

static void test_half_of_a_processor_is_the_limit(void)
{
    struct md_realtime realtime = {0};
    assert(md_realtime_start(&realtime) == 0 && policy() == SCHED_FIFO);
    int64_t due_ns = realtime.checked_ns + CHECK_NS;

    realtime.used_ns -= CHECK_NS;
    md_realtime_check(&realtime, due_ns - 1); /* not yet */
    assert(realtime.is_on);

    realtime.used_ns = used_ns() - CHECK_NS / 3;
    md_realtime_check(&realtime, due_ns);
    assert(realtime.is_on && policy() == SCHED_FIFO && realtime.checked_ns == due_ns);

    realtime.used_ns -= CHECK_NS / 2;
    md_realtime_check(&realtime, due_ns + CHECK_NS);
    assert(!realtime.is_on && policy() == SCHED_OTHER);
}

static void test_children_have_normal_scheduling(void)
{
    struct md_realtime realtime = {0};
    int status;
    assert(md_realtime_start(&realtime) == 0);
    pid_t child = fork();
    if (!child)
        _exit((int)policy());
    assert(waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == SCHED_OTHER);
    md_realtime_end(&realtime);
}

static void test_a_thread_that_hangs_ends_the_process(void)
{
    int status;
    pid_t child = fork();
    if (!child) {
        struct md_realtime realtime = {0};
        md_realtime_start(&realtime);
        realtime.used_ns = used_ns() - MOST_CPU_NS; /* used since the last check */
        set_timer(&realtime);
        for (;;)
            ;
    }
    assert(waitpid(child, &status, 0) == child && WIFSIGNALED(status) && WTERMSIG(status) == SIGXCPU);
}

int main(void)
{
    struct md_realtime realtime = {0};
    if (md_realtime_start(&realtime)) {
        puts("this process may not use realtime scheduling");
        return 77;
    }
    md_realtime_end(&realtime);
    test_half_of_a_processor_is_the_limit();
    test_children_have_normal_scheduling();
    test_a_thread_that_hangs_ends_the_process();
    return 0;
}
