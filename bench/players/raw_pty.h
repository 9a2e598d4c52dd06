/* A raw pty that does not block, and stays alive between clients. */
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
    int slave = open(ptsname(master), O_RDWR | O_NOCTTY); /* keeps it alive */
    struct termios raw;
    tcgetattr(slave, &raw);
    cfmakeraw(&raw);
    tcsetattr(slave, TCSANOW, &raw);
    return master;
}

/* Open one and print its path. */
static inline int announce_pty(void)
{
    int master = open_raw_pty();
    puts(ptsname(master));
    fflush(stdout);
    return master;
}

#endif
