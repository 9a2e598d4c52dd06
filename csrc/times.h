/* Of two times the one or the other. */
#ifndef MULTIDROP_TIMES_H
#define MULTIDROP_TIMES_H

#include <stdint.h>

static inline int64_t later(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

static inline int64_t sooner(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

#endif
