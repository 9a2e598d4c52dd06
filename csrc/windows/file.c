/* Read and write COM ports and sockets on the engine's thread.
 *
 * A watched file has an overlapped read of one byte in progress. The read's completion routine runs while
 * the thread waits, and reports to the waiter that bytes have come; the other bytes are then read without
 * waiting. Timeouts of COM ports would be too coarse: they are whole milliseconds. */
#include "file.h"
#include "../engine.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

/* ---- errors ---- */

/* Windows errors as the errno of POSIX, which the core and Python use. */
static const struct {
    DWORD error;
    int number;
} known[] = {
    {WSAEWOULDBLOCK, EAGAIN},
    {WSAECONNRESET, ECONNRESET},
    {WSAECONNABORTED, ECONNABORTED},
    {WSAENETRESET, ENETRESET},
    {WSAENETDOWN, ENETDOWN},
    {WSAEHOSTUNREACH, EHOSTUNREACH},
    {WSAETIMEDOUT, ETIMEDOUT},
    {WSAENOTCONN, ENOTCONN},
    {WSAESHUTDOWN, EPIPE},
    {ERROR_NETNAME_DELETED, ECONNRESET}, /* from overlapped reads */
    {ERROR_CONNECTION_ABORTED, ECONNABORTED},
    {ERROR_SEM_TIMEOUT, ETIMEDOUT},
    {ERROR_INVALID_HANDLE, EBADF},
    {ERROR_NOT_ENOUGH_MEMORY, ENOMEM},
    {ERROR_INVALID_PARAMETER, EINVAL},
    {ERROR_INVALID_FUNCTION, ENOTTY},
    {ERROR_NOT_SUPPORTED, EOPNOTSUPP},
    /* an unplugged adapter, depending on the driver */
    {ERROR_ACCESS_DENIED, ENODEV},
    {ERROR_BAD_COMMAND, ENODEV},
    {ERROR_DEVICE_NOT_CONNECTED, ENODEV},
    {ERROR_DEVICE_REMOVED, ENODEV},
    {ERROR_FILE_NOT_FOUND, ENODEV},
    {ERROR_NO_SUCH_DEVICE, ENODEV},
    {ERROR_OPERATION_ABORTED, ENODEV},
};

int md_errno_of(DWORD error)
{
    for (size_t i = 0; i < sizeof known / sizeof *known; i++)
        if (known[i].error == error)
            return known[i].number;
    return EIO;
}

enum {
    MOST_LEAVING_MS = 100, /* how long removing a file waits until its last request has left */
    MOST_CANCELLED_MS = 1000,
    MOST_COMPLETING_MS = 5
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

/* ---- completions while the thread waits ---- */

/* Add the file to the list of ready files if it has bytes or a failure to report. */
static void list_ready(struct md_file *file)
{
    int has_news = file->is_held || file->is_ended || file->error;
    if (!has_news || !file->is_watched || file->is_ready)
        return;
    file->is_ready = 1;
    file->next_ready = first_ready;
    first_ready = file;
}

void md_file_has_read(struct md_file *file, DWORD error, DWORD got)
{
    file->is_reading = 0;
    file->is_held = !error && got;
    file->is_ended = !error && !got;
    if (error)
        file->error = md_errno_of(error);
    list_ready(file);
}

void md_file_has_written(struct md_file *file, DWORD error)
{
    file->is_writing = 0;
    if (error)
        file->error = md_errno_of(error);
    list_ready(file);
}

/* Start to read one byte ahead from the file, unless that byte has come or its read is in progress. */
static void begin(struct md_file *file)
{
    if (file->is_reading || file->is_held || file->is_ended || file->error)
        return;
    file->reading = (OVERLAPPED){.hEvent = file};
    file->is_reading = 1;
    DWORD error = file->kind->begin(file);
    if (error)
        md_file_has_read(file, error, 0);
}

/* ---- for port.c ---- */

/* Complete the pending read if a byte has come. Windows completes the read immediately. Wine completes it
 * later, in another process. So wait if the driver's queue has the byte, because it has come in time. */
static void complete(struct md_file *file)
{
    if (file->is_reading)
        md_run_completed();
    for (int ms = 0; ms < MOST_COMPLETING_MS && file->is_reading && file->kind->has_bytes(file); ms++)
        SleepEx(1, TRUE);
}

ssize_t md_descriptor_read(int fd, void *bytes, size_t room)
{
    struct md_file *file = find(fd);
    if (!file)
        return md_fail(ERROR_INVALID_HANDLE);
    complete(file);
    if (file->is_reading) /* no byte has come */
        return md_fail(WSAEWOULDBLOCK);
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
    if (file->is_watched) /* if the file has just ended or failed, the new read reports that again */
        begin(file);
    errno = error;
    return got > 0 ? got + (ssize_t)held : held ? 1 : got;
}

ssize_t md_descriptor_write(int fd, const void *bytes, size_t len)
{
    struct md_file *file = find(fd);
    return file ? file->kind->write(file, bytes, len) : md_fail(ERROR_INVALID_HANDLE);
}

/* ---- for waiter.c and com.c ---- */

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

int md_file_add(int fd, void *owner)
{
    HANDLE handle = handle_of(fd);
    DWORD type = fd > 0 ? GetFileType(handle) : FILE_TYPE_UNKNOWN;
    if (type == FILE_TYPE_UNKNOWN) {
        errno = EBADF;
        return -1;
    }
    if (type == FILE_TYPE_CHAR && !md_port_prepare(handle))
        return (int)md_fail(GetLastError());
    struct md_file *file = grow((unsigned)fd / 4) ? calloc(1, sizeof *file) : NULL;
    if (!file) {
        errno = ENOMEM;
        return -1;
    }
    file->handle = handle;
    file->kind = type == FILE_TYPE_CHAR ? &md_port_kind : &md_socket_kind;
    file->owner = owner;
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
    if (!is_watched) /* the pending read causes one more wake-up; cancelling it would cost as much */
        return;
    begin(file);
    list_ready(file);
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
        SleepEx(1, TRUE); /* do not cut off a stop that is leaving */
    CancelIoEx(file->handle, NULL);
    for (int ms = 0; ms < MOST_CANCELLED_MS && (file->is_reading || file->is_writing); ms++)
        SleepEx(1, TRUE);
    unlist(file);
    if (!file->is_reading && !file->is_writing) /* the system no longer uses the file's memory */
        free(file);
}

int md_files_ready(void **owners, int room)
{
    int n = 0;
    while (first_ready && n < room) {
        struct md_file *file = first_ready;
        first_ready = file->next_ready;
        file->is_ready = 0;
        if (file->is_watched)
            owners[n++] = file->owner;
    }
    return n;
}

int md_file_is_writing(int fd)
{
    struct md_file *file = find(fd);
    if (!file)
        return 0;
    md_run_completed();
    return file->is_writing;
}
