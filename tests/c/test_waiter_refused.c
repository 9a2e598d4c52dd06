/* Waiting works with epoll_pwait2(), and without it, as on old kernels and in some containers. */
#define _GNU_SOURCE
#include "internal.h"

#include <assert.h>
#include <errno.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <stddef.h>
#include <stdio.h>
#include <sys/epoll.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { SKIPPED = 77 };

/* Make epoll_pwait2() fail with this error in this process from now on; return 0 if that is not possible. */
static int refuse(unsigned call, unsigned error)
{
    struct sock_filter filter[] = {
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, call, 0, 1),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | error),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
    };
    struct sock_fprog program = {.len = sizeof filter / sizeof *filter, .filter = filter};
    return prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0 && prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER,
                                                            &program) == 0;
}

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void wait_for_both(void)
{
    int ends[2][2], whose[2];
    void *ready[2];
    struct md_waiter *waiter = md_waiter_new();
    assert(waiter);
    for (int i = 0; i < 2; i++)
        assert(pipe(ends[i]) == 0 && md_waiter_add(waiter, ends[i][0], &whose[i]) == 0);
    int64_t begun_ns = now_ns();
    assert(md_waiter_wait(waiter, ready, 2, 1234567) == 0);
    assert(now_ns() - begun_ns >= 1234567);
    assert(write(ends[1][1], "", 1) == 1);
    assert(md_waiter_wait(waiter, ready, 2, -1) == 1 && ready[0] == &whose[1]);
    assert(write(ends[0][1], "", 1) == 1);
    assert(md_waiter_wait(waiter, ready, 2, 0) == 2);
    assert(md_waiter_wait(waiter, ready, 1, 0) == 1);
    md_waiter_free(waiter);
}

static int try_without(unsigned error)
{
    if (!refuse(SYS_epoll_pwait2, error))
        return SKIPPED;
    assert(syscall(SYS_epoll_pwait2, -1, NULL, 0, NULL, NULL, (size_t)0) == -1 && errno == (int)error);
    wait_for_both();
    return 0;
}

int main(void)
{
    wait_for_both(); /* first with all calls of this system */
    static const unsigned errors[] = {ENOSYS, EPERM};
    for (size_t i = 0; i < sizeof errors / sizeof *errors; i++) {
        int status;
        pid_t child = fork();
        if (child == 0)
            _exit(try_without(errors[i]));
        assert(child > 0 && waitpid(child, &status, 0) == child && WIFEXITED(status));
        if (WEXITSTATUS(status) == SKIPPED)
            puts("this system filters no calls (seccomp)");
        if (WEXITSTATUS(status))
            return WEXITSTATUS(status);
    }
    return 0;
}
