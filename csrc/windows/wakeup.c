/* An event by which any thread wakes the one that waits. */
#include "file.h"

#include <errno.h>

int md_wakeup_make(struct md_wakeup *wakeup)
{
    HANDLE event = CreateEventW(NULL, FALSE, FALSE, NULL); /* resets itself when a wait ends by it */
    *wakeup = (struct md_wakeup){.fd = (int)(intptr_t)event};
    errno = event ? 0 : ENOMEM;
    return event ? 0 : -1;
}

void md_wakeup_destroy(struct md_wakeup *wakeup)
{
    CloseHandle(handle_of(wakeup->fd));
}

void md_wakeup_ring(struct md_wakeup *wakeup)
{
    if (!atomic_exchange(&wakeup->is_rung, 1))
        SetEvent(handle_of(wakeup->fd));
}

/* A ring before this announces what the thread is about to look at; one after it ends the next wait. */
void md_wakeup_silence(struct md_wakeup *wakeup)
{
    atomic_store(&wakeup->is_rung, 0);
}
