/* A non-blocking raw pty that stays open between clients. */
#ifndef RAW_PTY_H
#define RAW_PTY_H

#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>

static int open_raw_pty(void)
{
    int master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (master < 0 || grantpt(master) || unlockpt(master)) {
        perror("no pty");
        exit(1);
    }
    int slave = open(ptsname(master), O_RDWR | O_NOCTTY); /* keeps the pty open without a client */
    struct termios raw;
    tcgetattr(slave, &raw);
    cfmakeraw(&raw);
    tcsetattr(slave, TCSANOW, &raw);
    return master;
}

/* Open a raw pty, print its path, and return its descriptor. */
static inline int announce_pty(void)
{
    int master = open_raw_pty();
    puts(ptsname(master));
    fflush(stdout);
    return master;
}

#endif
