/* Sockets that Python has created; only the core reads, writes and waits for them. */
#include "file.h"

static void CALLBACK socket_has_read(DWORD error, DWORD got, OVERLAPPED *reading, DWORD flags)
{
    (void)flags;
    md_file_has_read(reading->hEvent, error, got);
}

static DWORD begin_socket(struct md_file *file)
{
    WSABUF buffer = {.len = 1, .buf = (char *)&file->byte};
    DWORD flags = 0;
    int is_begun = !WSARecv((SOCKET)file->handle, &buffer, 1, NULL, &flags, &file->reading, socket_has_read);
    DWORD error = is_begun ? 0 : (DWORD)WSAGetLastError();
    return error == WSA_IO_PENDING ? 0 : error;
}

static int socket_has_bytes(struct md_file *file)
{
    u_long count = 0;
    return !ioctlsocket((SOCKET)file->handle, FIONREAD, &count) && count;
}

static ssize_t read_socket(struct md_file *file, void *bytes, size_t room)
{
    int got = recv((SOCKET)file->handle, bytes, (int)room, 0);
    return got < 0 ? md_fail((DWORD)WSAGetLastError()) : got;
}

static ssize_t write_socket(struct md_file *file, const void *bytes, size_t len)
{
    int written = send((SOCKET)file->handle, bytes, (int)len, 0);
    return written < 0 ? md_fail((DWORD)WSAGetLastError()) : written;
}

const struct md_file_kind md_socket_kind = {read_socket, socket_has_bytes, begin_socket, write_socket};
