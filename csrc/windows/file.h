/* The handles that the engine's thread reads from and writes to: COM ports and sockets. */
#ifndef MULTIDROP_FILE_H
#define MULTIDROP_FILE_H

#include "../internal.h"

#define WIN32_LEAN_AND_MEAN
#include <winsock2.h>
#include <windows.h>

/* ---- file.c ---- */

int md_file_add(int fd, void *whose); /* -1: see errno */
void md_file_watch(int fd, int is_watched);
void md_file_remove(int fd);
/* Write whose watched files have something to read, and return how many. */
int md_files_ready(void **whose, int room);
int md_file_is_writing(int fd); /* what was written last has not left yet */

/* ---- failure.c ---- */

int md_errno_of(DWORD error); /* of GetLastError() or WSAGetLastError() */

static inline HANDLE handle_of(int fd)
{
    return (HANDLE)(intptr_t)fd;
}

#endif
