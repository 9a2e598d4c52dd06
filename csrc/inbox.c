/* What the thread leaves for a client: rows of what was carried out, and calls to look at a port.
 *
 * The thread never waits for a client: rows gather in chunks of bounded number. It holds the lock for
 * as long as one exchange's rows take, and a client for as long as it takes to unhook a chunk. */
#define _GNU_SOURCE
#include "multidrop.h"

#include <errno.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static const int64_t CLOCK_HOLDS_NS = 50000000; /* until it is asked again how far UTC is ahead */

enum { MOST_SPARE = 64 }; /* chunks that were given back */

struct md_inbox {
    pthread_mutex_t mutex; /* guards all below */
    pthread_cond_t called_up;
    size_t chunk_rows, most_chunks;
    struct md_columns **chunks; /* a ring */
    size_t first, count;        /* of the chunks that hold rows */
    struct md_columns *spare[MOST_SPARE];
    size_t spares;
    size_t lent;                /* chunks that were taken and not given back yet */
    int is_done;                /* its client needs it no more */
    uint64_t dropped;
    int64_t utc_minus_monotonic_ns, asked_ns;
    uint64_t called[MD_MOST_NUMBERS / 64]; /* a bit for each number */
    uint32_t least, most;                  /* of those that are called */
};

/* Whose time-outs no change of the time of day can touch. */
static void init_condition(pthread_cond_t *condition)
{
#ifdef __APPLE__
    pthread_cond_init(condition, NULL);
#else
    pthread_condattr_t monotonic;
    pthread_condattr_init(&monotonic);
    pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
    pthread_cond_init(condition, &monotonic);
    pthread_condattr_destroy(&monotonic);
#endif
}

static int wait_until(pthread_cond_t *condition, pthread_mutex_t *mutex, int64_t until_ns)
{
#ifdef __APPLE__
    int64_t left = until_ns - md_now_ns();
    struct timespec span = {.tv_sec = left > 0 ? left / 1000000000 : 0, .tv_nsec = left > 0 ? left % 1000000000 : 0};
    return pthread_cond_timedwait_relative_np(condition, mutex, &span);
#else
    struct timespec until = {.tv_sec = until_ns / 1000000000, .tv_nsec = until_ns % 1000000000};
    return pthread_cond_timedwait(condition, mutex, &until);
#endif
}

struct md_inbox *md_inbox_new(size_t chunk_rows, size_t most_chunks)
{
    struct md_inbox *inbox = calloc(1, sizeof *inbox);
    struct md_columns **chunks = calloc(most_chunks, sizeof *chunks);
    if (!inbox || !chunks) {
        free(inbox);
        free(chunks);
        return NULL;
    }
    inbox->chunks = chunks;
    inbox->chunk_rows = chunk_rows;
    inbox->most_chunks = most_chunks;
    inbox->least = MD_MOST_NUMBERS;
    pthread_mutex_init(&inbox->mutex, NULL);
    init_condition(&inbox->called_up);
    return inbox;
}

static void destroy(struct md_inbox *inbox)
{
    for (size_t i = 0; i < inbox->count; i++)
        md_columns_free(inbox->chunks[(inbox->first + i) % inbox->most_chunks]);
    while (inbox->spares)
        md_columns_free(inbox->spare[--inbox->spares]);
    pthread_cond_destroy(&inbox->called_up);
    pthread_mutex_destroy(&inbox->mutex);
    free(inbox->chunks);
    free(inbox);
}

/* A chunk may be looked at for longer than its inbox: a collector of garbage ends them in any order. */
void md_inbox_free(struct md_inbox *inbox)
{
    pthread_mutex_lock(&inbox->mutex);
    inbox->is_done = 1;
    int is_last = inbox->lent == 0;
    pthread_mutex_unlock(&inbox->mutex);
    if (is_last)
        destroy(inbox);
}

/* ---- rows ---- */

static void ask_clock(struct md_inbox *inbox, int64_t now_ns)
{
    if (inbox->asked_ns && now_ns - inbox->asked_ns < CLOCK_HOLDS_NS)
        return;
    inbox->asked_ns = now_ns;
    inbox->utc_minus_monotonic_ns = md_utc_minus_monotonic_ns();
}

static struct md_columns *newest(struct md_inbox *inbox)
{
    return inbox->count ? inbox->chunks[(inbox->first + inbox->count - 1) % inbox->most_chunks] : NULL;
}

/* A chunk with no rows yet: a new one, or else the newest, whose rows are dropped. */
static struct md_columns *begin_chunk(struct md_inbox *inbox)
{
    struct md_columns *chunk = NULL;
    if (inbox->count < inbox->most_chunks)
        chunk = inbox->spares ? inbox->spare[--inbox->spares] : md_columns_new(inbox->chunk_rows);
    if (chunk) {
        inbox->chunks[(inbox->first + inbox->count++) % inbox->most_chunks] = chunk;
    } else if ((chunk = newest(inbox)) != NULL) {
        inbox->dropped += chunk->rows;
        chunk->rows = 0;
    }
    return chunk;
}

void md_inbox_add(struct md_inbox *inbox, const struct md_block *block, const struct md_completion *completion)
{
    if (!block || block->count == 0)
        return;
    pthread_mutex_lock(&inbox->mutex);
    ask_clock(inbox, completion->begun_ns);
    struct md_columns *chunk = newest(inbox);
    if (!chunk || !md_columns_add(chunk, block, completion, inbox->utc_minus_monotonic_ns)) {
        chunk = begin_chunk(inbox);
        if (!chunk || !md_columns_add(chunk, block, completion, inbox->utc_minus_monotonic_ns))
            inbox->dropped += (uint64_t)block->count;
    }
    pthread_mutex_unlock(&inbox->mutex);
}

struct md_columns *md_inbox_take(struct md_inbox *inbox)
{
    struct md_columns *chunk = NULL;
    pthread_mutex_lock(&inbox->mutex);
    if (inbox->count) {
        chunk = inbox->chunks[inbox->first];
        inbox->first = (inbox->first + 1) % inbox->most_chunks;
        inbox->count--;
        inbox->lent++;
    }
    pthread_mutex_unlock(&inbox->mutex);
    return chunk;
}

void md_inbox_give_back(struct md_inbox *inbox, struct md_columns *columns)
{
    columns->rows = 0;
    pthread_mutex_lock(&inbox->mutex);
    int is_kept = inbox->spares < MOST_SPARE;
    if (is_kept)
        inbox->spare[inbox->spares++] = columns;
    int is_last = --inbox->lent == 0 && inbox->is_done;
    pthread_mutex_unlock(&inbox->mutex);
    if (!is_kept)
        md_columns_free(columns);
    if (is_last)
        destroy(inbox);
}

size_t md_inbox_chunks(struct md_inbox *inbox)
{
    pthread_mutex_lock(&inbox->mutex);
    size_t count = inbox->count;
    pthread_mutex_unlock(&inbox->mutex);
    return count;
}

uint64_t md_inbox_dropped(struct md_inbox *inbox)
{
    pthread_mutex_lock(&inbox->mutex);
    uint64_t dropped = inbox->dropped;
    pthread_mutex_unlock(&inbox->mutex);
    return dropped;
}

/* ---- calls ---- */

void md_inbox_call(struct md_inbox *inbox, uint32_t number)
{
    pthread_mutex_lock(&inbox->mutex);
    inbox->called[number / 64] |= UINT64_C(1) << number % 64;
    inbox->least = number < inbox->least ? number : inbox->least;
    inbox->most = number > inbox->most ? number : inbox->most;
    pthread_cond_signal(&inbox->called_up);
    pthread_mutex_unlock(&inbox->mutex);
}

static int take_calls(struct md_inbox *inbox, uint32_t *numbers, int room)
{
    int n = 0;
    uint32_t number = inbox->least;
    for (; number <= inbox->most && n < room; number++) {
        uint64_t bit = UINT64_C(1) << number % 64;
        if (inbox->called[number / 64] & bit)
            numbers[n++] = number;
        inbox->called[number / 64] &= ~bit;
    }
    inbox->least = number;
    if (number > inbox->most) {
        inbox->least = MD_MOST_NUMBERS;
        inbox->most = 0;
    }
    return n;
}

int md_inbox_await(struct md_inbox *inbox, int64_t timeout_ns, uint32_t *numbers, int room)
{
    int64_t until_ns = md_now_ns() + timeout_ns;
    pthread_mutex_lock(&inbox->mutex);
    while (inbox->least > inbox->most && wait_until(&inbox->called_up, &inbox->mutex, until_ns) == 0)
        ;
    int n = take_calls(inbox, numbers, room);
    pthread_mutex_unlock(&inbox->mutex);
    return n;
}
