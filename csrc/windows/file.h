/* The handles that the engine's thread reads from and writes to: COM ports and sockets. */
#ifndef MULTIDROP_FILE_H
#define MULTIDROP_FILE_H

#include "../internal.h"

#include <errno.h>
#include <sys/types.h>

#define WIN32_LEAN_AND_MEAN
#include <winsock2.h>
#include <windows.h>

struct md_file {
    HANDLE handle;
    const struct md_file_kind *kind;
    void *owner;
    int is_watched;
    int is_reading, is_writing; /* the system is reading `byte`, or writing `leaving` */
    int is_held;                /* `byte` has come, but was not read by the core yet */
    int is_ended, error;        /* whether the far end hung up; the errno of a failure, or 0 */
    int is_ready;               /* whether the file is in the list of ready files */
    struct md_file *next_ready;
    OVERLAPPED reading, writing;
    uint8_t byte;
    uint8_t leaving[MD_MOST_FRAME];
};

/* The calls that differ between COM ports and sockets. On failure, read() and write() return -1 and set
 * errno. */
struct md_file_kind {
    ssize_t (*read)(struct md_file *file, void *bytes, size_t room); /* the available bytes */
    int (*has_bytes)(struct md_file *file);
    DWORD (*begin)(struct md_file *file); /* start to read `byte`; return an error, or 0 */
    ssize_t (*write)(struct md_file *file, const void *bytes, size_t len);
};

/* ---- com.c, socket.c ---- */

extern const struct md_file_kind md_port_kind, md_socket_kind;

int md_port_prepare(HANDLE handle); /* remove the timeouts of reads and writes; 0 on failure */

/* ---- file.c ---- */

/* Record that the read of `byte`, or the write, is complete. */
void md_file_has_read(struct md_file *file, DWORD error, DWORD got);
void md_file_has_written(struct md_file *file, DWORD error);

int md_file_add(int fd, void *owner); /* -1: see errno */
void md_file_watch(int fd, int is_watched);
void md_file_remove(int fd);
/* Fill `owners` with the owners of watched files that can be read; return their number. */
int md_files_ready(void **owners, int room);
int md_file_is_writing(int fd); /* 1: the last request has not left yet */

int md_errno_of(DWORD error); /* `error` is from GetLastError() or WSAGetLastError() */

static inline ssize_t md_fail(DWORD error) /* set errno, return -1 */
{
    errno = md_errno_of(error);
    return -1;
}

/* Run the routines of completed reads and writes. */
static inline void md_run_completed(void)
{
    SleepEx(0, TRUE);
}

static inline HANDLE handle_of(int fd)
{
    return (HANDLE)(intptr_t)fd;
}

#endif
