/* COM ports: wait for one byte, read all that has come, and let a request leave while the thread goes on. */
#include "file.h"

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

/* No time-outs: a read ends with its byte alone, and a write with its last byte. */
int md_port_prepare(HANDLE handle)
{
    COMMTIMEOUTS none = {0};
    return SetCommTimeouts(handle, &none) && SetCommMask(handle, 0);
}

const struct md_file_kind md_port_kind = {read_port, port_has_bytes, begin_port, write_port};
