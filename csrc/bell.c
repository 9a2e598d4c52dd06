/* A bell: any thread may ring it, and whoever waits for its descriptor wakes. */
#include "waiter.h"

#include <fcntl.h>
#include <unistd.h>

static int set_up(int fd)
{
    return fcntl(fd, F_SETFD, FD_CLOEXEC) == 0 && fcntl(fd, F_SETFL, O_NONBLOCK) == 0;
}

int md_bell_make(struct md_bell *bell)
{
    int ends[2];
    if (pipe(ends))
        return -1;
    *bell = (struct md_bell){.fd = ends[0], .ringer = ends[1]};
    if (set_up(ends[0]) && set_up(ends[1]))
        return 0;
    md_bell_destroy(bell);
    return -1;
}

void md_bell_destroy(struct md_bell *bell)
{
    close(bell->fd);
    close(bell->ringer);
}

void md_bell_ring(struct md_bell *bell)
{
    if (!atomic_exchange(&bell->is_rung, 1))
        (void)!write(bell->ringer, "", 1);
}

/* What rings while this goes on leaves a byte, and is heard. */
void md_bell_silence(struct md_bell *bell)
{
    char byte;
    atomic_store(&bell->is_rung, 0);
    (void)!read(bell->fd, &byte, 1);
}
