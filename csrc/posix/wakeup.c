/* A pipe with which any thread wakes the waiting thread. */
#include "internal.h"

#include <fcntl.h>
#include <unistd.h>

static int set_up(int fd)
{
    return fcntl(fd, F_SETFD, FD_CLOEXEC) == 0 && fcntl(fd, F_SETFL, O_NONBLOCK) == 0;
}

int md_wakeup_make(struct md_wakeup *wakeup)
{
    int ends[2];
    if (pipe(ends))
        return -1;
    *wakeup = (struct md_wakeup){.fd = ends[0], .ringer = ends[1]};
    if (set_up(ends[0]) && set_up(ends[1]))
        return 0;
    md_wakeup_destroy(wakeup);
    return -1;
}

void md_wakeup_destroy(struct md_wakeup *wakeup)
{
    close(wakeup->fd);
    close(wakeup->ringer);
}

void md_wakeup_ring(struct md_wakeup *wakeup)
{
    if (!atomic_exchange(&wakeup->is_rung, 1))
        (void)!write(wakeup->ringer, "", 1);
}

/* If another thread calls md_wakeup_ring() meanwhile, its byte stays in the pipe: no wake-up is lost. */
void md_wakeup_silence(struct md_wakeup *wakeup)
{
    char byte;
    atomic_store(&wakeup->is_rung, 0);
    (void)!read(wakeup->fd, &byte, 1);
}
