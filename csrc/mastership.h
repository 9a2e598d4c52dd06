/* Until when this process may send, as the ports see it. */
#ifndef MULTIDROP_MASTERSHIP_H
#define MULTIDROP_MASTERSHIP_H

#include "engine.h"

struct md_mastership {
    int64_t until_ns;         /* of CLOCK_BOOTTIME; read and written atomically; 0: it does not hold */
    int64_t guard_ns;         /* from the end of one master to the beginning of the next */
    struct md_engine *engine; /* that looks at it; NULL: none does yet */
#ifdef __linux__
    timer_t timer;
#endif
};

#endif
