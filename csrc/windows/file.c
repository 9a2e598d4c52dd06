/* Reads and writes COM ports and sockets, all of them on the engine's thread.
 *
 * While a file is watched, one byte of it is being read, overlapped: its completion routine runs while the
 * thread waits, and so the waiter learns that there is something. All else is read at once, as much as has
 * come. Time-outs of a COM port would not do in place of that: they are whole milliseconds. */
#include "file.h"

#include "../descriptor.h"

#include <stdlib.h>
#include <string.h>

enum {
    MOST_LEAVING_MS = 100, /* that the end of a file waits for its last request to leave */
    MOST_CANCELLED_MS = 1000
};

struct md_file {
    HANDLE handle;
    const struct kind *kind;
    void *whose;
    int is_watched;
    int is_reading, is_writing; /* the system has its byte, or its request */
    int is_held;                /* its byte has come */
    int is_ended, error;        /* it hung up; an errno */
    int is_ready;               /* it is in the list of those */
    struct md_file *next_ready;
    OVERLAPPED reading, writing;
    uint8_t byte;
    uint8_t leaving[MD_MOST_FRAME];
};

/* The calls in which COM ports and sockets differ; the first and the last return -1 and set errno. */
struct kind {
    ssize_t (*read)(struct md_file *file, void *bytes, size_t room); /* what is there */
    DWORD (*begin)(struct md_file *file); /* to read its byte; return an error */
    ssize_t (*write)(struct md_file *file, const void *bytes, size_t len);
};

/* Files by their handles, which are small multiples of 4. */
static struct md_file **files;
static unsigned room_for;
static struct md_file *first_ready;

static struct md_file *find(int fd)
{
    unsigned at = (unsigned)fd / 4;
    return at < room_for ? files[at] : NULL;
}

static ssize_t fail(DWORD error)
{
    errno = md_errno_of(error);
    return -1;
}

/* ---- what completes while the thread waits ---- */

static void tell(struct md_file *file)
{
    int has_news = file->is_held || file->is_ended || file->error;
    if (!has_news || !file->is_watched || file->is_ready)
        return;
    file->is_ready = 1;
    file->next_ready = first_ready;
    first_ready = file;
}

static void has_read(struct md_file *file, DWORD error, DWORD got)
{
    file->is_reading = 0;
    file->is_held = !error && got;
    file->is_ended = !error && !got;
    if (error)
        file->error = md_errno_of(error);
    tell(file);
}

static void CALLBACK port_has_read(DWORD error, DWORD got, OVERLAPPED *reading)
{
    has_read(reading->hEvent, error, got);
}

static void CALLBACK socket_has_read(DWORD error, DWORD got, OVERLAPPED *reading, DWORD flags)
{
    (void)flags;
    has_read(reading->hEvent, error, got);
}

static void CALLBACK port_has_written(DWORD error, DWORD written, OVERLAPPED *writing)
{
    struct md_file *file = writing->hEvent;
    (void)written;
    file->is_writing = 0;
    if (error)
        file->error = md_errno_of(error);
    tell(file);
}

/* Have the completion routines run of what is complete. */
static void run_completed(void)
{
    SleepEx(0, TRUE);
}

/* Read its byte, unless it is there or on its way. */
static void begin(struct md_file *file)
{
    if (file->is_reading || file->is_held || file->is_ended || file->error)
        return;
    file->reading = (OVERLAPPED){.hEvent = file};
    file->is_reading = 1;
    DWORD error = file->kind->begin(file);
    if (error)
        has_read(file, error, 0);
}

/* ---- COM ports ---- */

static DWORD begin_port(struct md_file *file)
{
    return ReadFileEx(file->handle, &file->byte, 1, &file->reading, port_has_read) ? 0 : GetLastError();
}

static ssize_t read_port(struct md_file *file, void *bytes, size_t room)
{
    DWORD errors, got = 0;
    COMSTAT state;
    if (!ClearCommError(file->handle, &errors, &state))
        return fail(GetLastError());
    if (!state.cbInQue)
        return fail(WSAEWOULDBLOCK);
    DWORD most = state.cbInQue < room ? state.cbInQue : (DWORD)room;
    OVERLAPPED now = {.hEvent = CreateEventW(NULL, TRUE, FALSE, NULL)};
    if (!now.hEvent)
        return fail(GetLastError());
    int is_begun = ReadFile(file->handle, bytes, most, NULL, &now) || GetLastError() == ERROR_IO_PENDING;
    int is_read = is_begun && GetOverlappedResult(file->handle, &now, &got, TRUE);
    DWORD error = is_read ? 0 : GetLastError();
    CloseHandle(now.hEvent);
    return is_read ? (ssize_t)got : fail(error);
}

static ssize_t write_port(struct md_file *file, const void *bytes, size_t len)
{
    run_completed();
    if (file->is_writing)
        return fail(WSAEWOULDBLOCK);
    DWORD most = len < sizeof file->leaving ? (DWORD)len : (DWORD)sizeof file->leaving;
    memcpy(file->leaving, bytes, most);
    file->writing = (OVERLAPPED){.hEvent = file};
    if (!WriteFileEx(file->handle, file->leaving, most, &file->writing, port_has_written))
        return fail(GetLastError());
    file->is_writing = 1;
    return (ssize_t)most;
}

/* Nothing ends a read but the byte that it waits for, and nothing a write but its last byte. */
static int set_up_port(HANDLE handle)
{
    COMMTIMEOUTS none = {0};
    return SetCommTimeouts(handle, &none) && SetCommMask(handle, 0);
}

/* ---- sockets ---- */

static DWORD begin_socket(struct md_file *file)
{
    WSABUF buffer = {.len = 1, .buf = (char *)&file->byte};
    DWORD flags = 0;
    int is_begun = !WSARecv((SOCKET)file->handle, &buffer, 1, NULL, &flags, &file->reading, socket_has_read);
    DWORD error = is_begun ? 0 : (DWORD)WSAGetLastError();
    return error == WSA_IO_PENDING ? 0 : error;
}

static ssize_t read_socket(struct md_file *file, void *bytes, size_t room)
{
    int got = recv((SOCKET)file->handle, bytes, (int)room, 0);
    return got < 0 ? fail((DWORD)WSAGetLastError()) : got;
}

static ssize_t write_socket(struct md_file *file, const void *bytes, size_t len)
{
    int written = send((SOCKET)file->handle, bytes, (int)len, 0);
    return written < 0 ? fail((DWORD)WSAGetLastError()) : written;
}

static const struct kind port_kind = {read_port, begin_port, write_port};
static const struct kind socket_kind = {read_socket, begin_socket, write_socket};

/* ---- for port_io.c ---- */

ssize_t md_descriptor_read(int fd, void *bytes, size_t room)
{
    struct md_file *file = find(fd);
    if (file->is_reading)
        run_completed();
    if (file->is_reading) /* nothing has come since */
        return fail(WSAEWOULDBLOCK);
    size_t held = 0;
    if (file->is_held) {
        memcpy(bytes, &file->byte, 1);
        file->is_held = 0;
        held = 1;
    } else if (file->error) {
        errno = file->error;
        return -1;
    } else if (file->is_ended) {
        return 0;
    }
    ssize_t got = file->kind->read(file, (uint8_t *)bytes + held, room - held);
    int error = errno;
    if (file->is_watched) /* an end or a failure that came just now is found again by this */
        begin(file);
    errno = error;
    return got > 0 ? got + (ssize_t)held : held ? 1 : got;
}

ssize_t md_descriptor_write(int fd, const void *bytes, size_t len)
{
    struct md_file *file = find(fd);
    return file->kind->write(file, bytes, len);
}

/* ---- for waiter.c and rts.c ---- */

static int grow(unsigned at)
{
    if (at < room_for)
        return 1;
    unsigned room = at + 256;
    struct md_file **grown = realloc(files, room * sizeof(*files));
    if (!grown)
        return 0;
    memset(grown + room_for, 0, (room - room_for) * sizeof *grown);
    files = grown;
    room_for = room;
    return 1;
}

int md_file_add(int fd, void *whose)
{
    HANDLE handle = handle_of(fd);
    DWORD type = fd > 0 ? GetFileType(handle) : FILE_TYPE_UNKNOWN;
    if (type == FILE_TYPE_UNKNOWN) {
        errno = EBADF;
        return -1;
    }
    if (type == FILE_TYPE_CHAR && !set_up_port(handle))
        return (int)fail(GetLastError());
    struct md_file *file = grow((unsigned)fd / 4) ? calloc(1, sizeof *file) : NULL;
    if (!file) {
        errno = ENOMEM;
        return -1;
    }
    file->handle = handle;
    file->kind = type == FILE_TYPE_CHAR ? &port_kind : &socket_kind;
    file->whose = whose;
    files[(unsigned)fd / 4] = file;
    md_file_watch(fd, 1);
    return 0;
}

void md_file_watch(int fd, int is_watched)
{
    struct md_file *file = find(fd);
    if (!file)
        return;
    file->is_watched = is_watched;
    if (!is_watched) /* what is being read costs one waking more; to take it back would cost as much */
        return;
    begin(file);
    tell(file);
}

static void unlist(const struct md_file *file)
{
    struct md_file **at = &first_ready;
    while (*at && *at != file)
        at = &(*at)->next_ready;
    if (*at)
        *at = file->next_ready;
}

void md_file_remove(int fd)
{
    struct md_file *file = find(fd);
    if (!file)
        return;
    files[(unsigned)fd / 4] = NULL;
    file->is_watched = 0;
    int is_broken = file->error || file->is_ended;
    for (int ms = 0; ms < MOST_LEAVING_MS && file->is_writing && !is_broken; ms++)
        SleepEx(1, TRUE); /* a stop that leaves must not be cut off */
    CancelIoEx(file->handle, NULL);
    for (int ms = 0; ms < MOST_CANCELLED_MS && (file->is_reading || file->is_writing); ms++)
        SleepEx(1, TRUE);
    unlist(file);
    if (!file->is_reading && !file->is_writing) /* else the system may still write there */
        free(file);
}

int md_files_ready(void **whose, int room)
{
    int n = 0;
    while (first_ready && n < room) {
        struct md_file *file = first_ready;
        first_ready = file->next_ready;
        file->is_ready = 0;
        if (file->is_watched)
            whose[n++] = file->whose;
    }
    return n;
}

int md_file_is_writing(int fd)
{
    struct md_file *file = find(fd);
    if (!file)
        return 0;
    run_completed();
    return file->is_writing;
}
