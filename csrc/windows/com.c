/* COM ports: wait for one byte, read all available bytes, and send requests without blocking the thread. */
#include "file.h"
#include "../engine.h"

#include <errno.h>
#include <io.h>
#include <string.h>

static void CALLBACK port_has_read(DWORD error, DWORD got, OVERLAPPED *reading)
{
    md_file_has_read(reading->hEvent, error, got);
}

static void CALLBACK port_has_written(DWORD error, DWORD written, OVERLAPPED *writing)
{
    (void)written;
    md_file_has_written(writing->hEvent, error);
}

static DWORD begin_port(struct md_file *file)
{
    return ReadFileEx(file->handle, &file->byte, 1, &file->reading, port_has_read) ? 0 : GetLastError();
}

static int port_has_bytes(struct md_file *file)
{
    DWORD errors;
    COMSTAT state;
    return ClearCommError(file->handle, &errors, &state) && state.cbInQue;
}

static ssize_t read_port(struct md_file *file, void *bytes, size_t room)
{
    DWORD errors, got = 0;
    COMSTAT state;
    if (!ClearCommError(file->handle, &errors, &state))
        return md_fail(GetLastError());
    if (!state.cbInQue)
        return md_fail(WSAEWOULDBLOCK);
    DWORD most = state.cbInQue < room ? state.cbInQue : (DWORD)room;
    OVERLAPPED now = {.hEvent = CreateEventW(NULL, TRUE, FALSE, NULL)};
    if (!now.hEvent)
        return md_fail(GetLastError());
    int is_begun = ReadFile(file->handle, bytes, most, NULL, &now) || GetLastError() == ERROR_IO_PENDING;
    int is_read = is_begun && GetOverlappedResult(file->handle, &now, &got, TRUE);
    DWORD error = is_read ? 0 : GetLastError();
    CloseHandle(now.hEvent);
    return is_read ? (ssize_t)got : md_fail(error);
}

static ssize_t write_port(struct md_file *file, const void *bytes, size_t len)
{
    md_run_completed();
    if (file->is_writing)
        return md_fail(WSAEWOULDBLOCK);
    DWORD most = len < sizeof file->leaving ? (DWORD)len : (DWORD)sizeof file->leaving;
    memcpy(file->leaving, bytes, most);
    file->writing = (OVERLAPPED){.hEvent = file};
    if (!WriteFileEx(file->handle, file->leaving, most, &file->writing, port_has_written))
        return md_fail(GetLastError());
    file->is_writing = 1;
    return (ssize_t)most;
}

/* Disable timeouts: a read then ends when its byte has come, a write when its last byte has left. */
int md_port_prepare(HANDLE handle)
{
    COMMTIMEOUTS none = {0};
    return SetCommTimeouts(handle, &none) && SetCommMask(handle, 0);
}

const struct md_file_kind md_port_kind = {read_port, port_has_bytes, begin_port, write_port};

/* ---- speed and character format ---- */

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

uint32_t md_port_baud_base(int fd)
{
    (void)fd;
    return 0;
}

/* Windows clears RTS and DTR when a port is closed, and cannot keep them set. */
int md_port_keep_rts(int fd)
{
    (void)fd;
    return -EOPNOTSUPP;
}

int md_port_close(int fd, int other, int64_t most_ns)
{
    (void)most_ns;
    return dup2(other, fd) < 0 ? -errno : 0;
}

/* ---- one setting after another, to find the refused ones ---- */

static void set_baudrate(DCB *port, const struct md_settings *settings)
{
    port->BaudRate = settings->baudrate;
}

static void set_databits(DCB *port, const struct md_settings *settings)
{
    port->ByteSize = settings->databits;
}

/* The driver delivers a character even with a parity error; the frame's checksum is then wrong. */
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

/* ---- the direction of an RS-485 transceiver, switched by RTS ---- */

/* The driver raises RTS while it has bytes to send: Windows' own RS-485 mode. */
int md_descriptor_take_rs485(int fd)
{
    DCB port = {.DCBlength = sizeof port};
    if (!GetCommState(handle_of(fd), &port))
        return -md_errno_of(GetLastError());
    port.fRtsControl = RTS_CONTROL_TOGGLE;
    if (!SetCommState(handle_of(fd), &port) || !GetCommState(handle_of(fd), &port))
        return -md_errno_of(GetLastError());
    return port.fRtsControl == RTS_CONTROL_TOGGLE ? 0 : -EOPNOTSUPP;
}

int md_descriptor_set_rts(int fd, int is_up)
{
    return EscapeCommFunction(handle_of(fd), is_up ? SETRTS : CLRRTS) ? 0 : -md_errno_of(GetLastError());
}

int md_descriptor_is_shifted_out(int fd)
{
    (void)fd;
    return -ENOTTY; /* Windows has no call that reports this */
}

int md_descriptor_is_queued(int fd)
{
    DWORD errors;
    COMSTAT state;
    return md_file_is_writing(fd) || (ClearCommError(handle_of(fd), &errors, &state) && state.cbOutQue);
}
