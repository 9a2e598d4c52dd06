// Defines the names that the core needs from zig's libraries for Windows (winpthreads, and the start code of
// a DLL). A test link uses this file instead, because zig needs two minutes to compile the libraries. Their
// headers declare the names, and each wheel is linked with the libraries.

#define NAME(name) \
    void name(void); \
    void name(void) {}

NAME(DllMainCRTStartup)
NAME(__isnan)
NAME(clock_gettime64)
NAME(pthread_cond_broadcast)
NAME(pthread_cond_destroy)
NAME(pthread_cond_init)
NAME(pthread_cond_signal)
NAME(pthread_cond_timedwait64_relative_np)
NAME(pthread_cond_wait)
NAME(pthread_create)
NAME(pthread_mutex_destroy)
NAME(pthread_mutex_init)
NAME(pthread_mutex_lock)
NAME(pthread_mutex_unlock)
NAME(sched_yield)
