/* Sets a COM port's speed and character format, and finds out which of them its driver refuses. */
#include "file.h"

#include <errno.h>

static int get(int fd, DCB *now)
{
    *now = (DCB){.DCBlength = sizeof *now};
    return GetCommState(handle_of(fd), now) ? 0 : -md_errno_of(GetLastError());
}

int md_port_get(int fd, struct md_settings *settings)
{
    DCB now;
    int failure = get(fd, &now);
    if (!failure)
        *settings = (struct md_settings){
            .baudrate = now.BaudRate,
            .databits = now.ByteSize == 7 ? 7 : 8,
            .parity = now.Parity == NOPARITY ? 'N' : now.Parity == ODDPARITY ? 'O' : 'E',
            .stopbits = now.StopBits == TWOSTOPBITS ? 2 : 1,
        };
    return failure;
}

/* RTS and DTR fall when a port is closed, and nothing keeps them up. */
int md_port_keep_rts(int fd)
{
    (void)fd;
    return -EOPNOTSUPP;
}

/* ---- one setting after another, to find out which of them is refused ---- */

static void set_baudrate(DCB *port, const struct md_settings *settings)
{
    port->BaudRate = settings->baudrate;
}

static void set_databits(DCB *port, const struct md_settings *settings)
{
    port->ByteSize = settings->databits;
}

/* The driver hands on a character with a parity error, and its frame's checksum is wrong. */
static void set_parity(DCB *port, const struct md_settings *settings)
{
    port->Parity = settings->parity == 'N' ? NOPARITY : settings->parity == 'O' ? ODDPARITY : EVENPARITY;
    port->fParity = port->Parity != NOPARITY;
}

static void set_stopbits(DCB *port, const struct md_settings *settings)
{
    port->StopBits = settings->stopbits == 2 ? TWOSTOPBITS : ONESTOPBIT;
}

static const struct {
    int refusal;
    void (*set)(DCB *port, const struct md_settings *settings);
} steps[] = {
    {MD_REFUSED_BAUDRATE, set_baudrate},
    {MD_REFUSED_DATABITS, set_databits},
    {MD_REFUSED_PARITY, set_parity},
    {MD_REFUSED_STOPBITS, set_stopbits},
};
enum { STEPS = sizeof steps / sizeof *steps };

static void make_raw(DCB *port)
{
    port->fBinary = TRUE;
    port->fOutxCtsFlow = port->fOutxDsrFlow = port->fDsrSensitivity = FALSE;
    port->fOutX = port->fInX = port->fErrorChar = port->fNull = port->fAbortOnError = FALSE;
}

int md_port_set(int fd, const struct md_settings *settings)
{
    HANDLE handle = handle_of(fd);
    DCB port;
    int failure = get(fd, &port), refused = 0;
    if (failure)
        return failure;
    make_raw(&port);
    DCB wanted = port;
    for (int i = 0; i < STEPS; i++)
        steps[i].set(&wanted, settings);
    if (SetCommState(handle, &wanted))
        return 0;
    if (GetLastError() != ERROR_INVALID_PARAMETER)
        return -md_errno_of(GetLastError());
    for (int i = 0; i < STEPS; i++) {
        DCB before = port;
        steps[i].set(&port, settings);
        if (SetCommState(handle, &port))
            continue;
        refused |= steps[i].refusal;
        port = before;
    }
    return refused;
}
