/* Windows' errors in the words of POSIX, which the rest of the core and Python speak. */
#include "file.h"

#include <errno.h>

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
    {ERROR_NETNAME_DELETED, ECONNRESET}, /* overlapped reads say it so */
    {ERROR_CONNECTION_ABORTED, ECONNABORTED},
    {ERROR_SEM_TIMEOUT, ETIMEDOUT},
    {ERROR_INVALID_HANDLE, EBADF},
    {ERROR_NOT_ENOUGH_MEMORY, ENOMEM},
    {ERROR_INVALID_PARAMETER, EINVAL},
    {ERROR_INVALID_FUNCTION, ENOTTY},
    {ERROR_NOT_SUPPORTED, EOPNOTSUPP},
    /* an adapter that was unplugged; which of them comes is the driver's choice */
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
