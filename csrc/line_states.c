/* The states of a line, and what leads from one to the next. */
#include "line.h"

enum { IDLE = MD_IDLE, SILENCE, CHECK, READY, WRITING, AWAITING, LAST_LOOK, NONE = -1 };

const int8_t md_line_follows[MD_LINE_STATES][MD_LINE_EVENTS] = {
    /*              begun    silent  nothing stray    part     sent      timeout    in time   ended */
    [IDLE]      = { SILENCE, NONE,   NONE,   IDLE,    NONE,    NONE,     NONE,      NONE,     NONE },
    [SILENCE]   = { NONE,    CHECK,  NONE,   SILENCE, NONE,    NONE,     NONE,      NONE,     IDLE },
    [CHECK]     = { NONE,    NONE,   READY,  SILENCE, NONE,    NONE,     NONE,      NONE,     IDLE },
    [READY]     = { NONE,    NONE,   NONE,   SILENCE, WRITING, AWAITING, NONE,      NONE,     IDLE },
    [WRITING]   = { NONE,    NONE,   NONE,   WRITING, WRITING, AWAITING, NONE,      NONE,     IDLE },
    [AWAITING]  = { NONE,    NONE,   NONE,   NONE,    NONE,    NONE,     LAST_LOOK, AWAITING, IDLE },
    [LAST_LOOK] = { NONE,    NONE,   NONE,   NONE,    NONE,    NONE,     NONE,      AWAITING, IDLE },
};
