/* The direction of an RS-485 transceiver that hangs on a COM port's RTS. */
#include "file.h"

#include "../descriptor.h"

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
    return -ENOTTY; /* no call tells */
}

int md_descriptor_is_queued(int fd)
{
    DWORD errors;
    COMSTAT state;
    return md_file_is_writing(fd) || (ClearCommError(handle_of(fd), &errors, &state) && state.cbOutQue);
}
