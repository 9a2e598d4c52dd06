/* What the thread leaves for a client: rows of what was carried out, and calls to look at a port.
 *
 * The thread never waits for a client: rows gather in chunks of bounded number. It holds the lock for
 * as long as one exchange's rows take, and a client for as long as it takes to unhook a chunk. */
#define _GNU_SOURCE
#include "internal.h"

#include <errno.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static const int64_t CLOCK_HOLDS_NS = 50000000; /* until it is asked again how far UTC is ahead */

enum { MOST_SPARE = 64 }; /* chunks that were given back */

struct md_row_queue {
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

struct md_row_queue *md_row_queue_new(size_t chunk_rows, size_t most_chunks)
{
    struct md_row_queue *row_queue = calloc(1, sizeof *row_queue);
    struct md_columns **chunks = calloc(most_chunks, sizeof *chunks);
    if (!row_queue || !chunks) {
        free(row_queue);
        free(chunks);
        return NULL;
    }
    row_queue->chunks = chunks;
    row_queue->chunk_rows = chunk_rows;
    row_queue->most_chunks = most_chunks;
    row_queue->least = MD_MOST_NUMBERS;
    pthread_mutex_init(&row_queue->mutex, NULL);
    init_condition(&row_queue->called_up);
    return row_queue;
}

static void destroy(struct md_row_queue *row_queue)
{
    for (size_t i = 0; i < row_queue->count; i++)
        md_columns_free(row_queue->chunks[(row_queue->first + i) % row_queue->most_chunks]);
    while (row_queue->spares)
        md_columns_free(row_queue->spare[--row_queue->spares]);
    pthread_cond_destroy(&row_queue->called_up);
    pthread_mutex_destroy(&row_queue->mutex);
    free(row_queue->chunks);
    free(row_queue);
}

/* A chunk may be looked at for longer than its row_queue: a collector of garbage ends them in any order. */
void md_row_queue_free(struct md_row_queue *row_queue)
{
    pthread_mutex_lock(&row_queue->mutex);
    row_queue->is_done = 1;
    int is_last = row_queue->lent == 0;
    pthread_mutex_unlock(&row_queue->mutex);
    if (is_last)
        destroy(row_queue);
}

/* ---- rows ---- */

static void ask_clock(struct md_row_queue *row_queue, int64_t now_ns)
{
    if (row_queue->asked_ns && now_ns - row_queue->asked_ns < CLOCK_HOLDS_NS)
        return;
    row_queue->asked_ns = now_ns;
    row_queue->utc_minus_monotonic_ns = md_utc_minus_monotonic_ns();
}

static struct md_columns *newest(struct md_row_queue *row_queue)
{
    return row_queue->count ? row_queue->chunks[(row_queue->first + row_queue->count - 1) % row_queue->most_chunks] : NULL;
}

/* A chunk with no rows yet: a new one, or else the newest, whose rows are dropped. */
static struct md_columns *begin_chunk(struct md_row_queue *row_queue)
{
    struct md_columns *chunk = NULL;
    if (row_queue->count < row_queue->most_chunks)
        chunk = row_queue->spares ? row_queue->spare[--row_queue->spares] : md_columns_new(row_queue->chunk_rows);
    if (chunk) {
        row_queue->chunks[(row_queue->first + row_queue->count++) % row_queue->most_chunks] = chunk;
    } else if ((chunk = newest(row_queue)) != NULL) {
        row_queue->dropped += chunk->rows;
        chunk->rows = 0;
    }
    return chunk;
}

void md_row_queue_add(struct md_row_queue *row_queue, const struct md_block *block, const struct md_completion *completion)
{
    if (!block || block->count == 0)
        return;
    pthread_mutex_lock(&row_queue->mutex);
    ask_clock(row_queue, completion->begun_ns);
    struct md_columns *chunk = newest(row_queue);
    if (!chunk || !md_columns_add(chunk, block, completion, row_queue->utc_minus_monotonic_ns)) {
        chunk = begin_chunk(row_queue);
        if (!chunk || !md_columns_add(chunk, block, completion, row_queue->utc_minus_monotonic_ns))
            row_queue->dropped += (uint64_t)block->count;
    }
    pthread_mutex_unlock(&row_queue->mutex);
}

void md_row_queue_miss(struct md_row_queue *row_queue, const struct md_block *block, int status, int64_t due_ns)
{
    md_row_queue_add(row_queue, block, &(struct md_completion){.result = -status, .begun_ns = due_ns});
}

struct md_columns *md_row_queue_take(struct md_row_queue *row_queue)
{
    struct md_columns *chunk = NULL;
    pthread_mutex_lock(&row_queue->mutex);
    if (row_queue->count) {
        chunk = row_queue->chunks[row_queue->first];
        row_queue->first = (row_queue->first + 1) % row_queue->most_chunks;
        row_queue->count--;
        row_queue->lent++;
    }
    pthread_mutex_unlock(&row_queue->mutex);
    return chunk;
}

void md_row_queue_give_back(struct md_row_queue *row_queue, struct md_columns *columns)
{
    columns->rows = 0;
    pthread_mutex_lock(&row_queue->mutex);
    int is_kept = row_queue->spares < MOST_SPARE;
    if (is_kept)
        row_queue->spare[row_queue->spares++] = columns;
    int is_last = --row_queue->lent == 0 && row_queue->is_done;
    pthread_mutex_unlock(&row_queue->mutex);
    if (!is_kept)
        md_columns_free(columns);
    if (is_last)
        destroy(row_queue);
}

size_t md_row_queue_chunks(struct md_row_queue *row_queue)
{
    pthread_mutex_lock(&row_queue->mutex);
    size_t count = row_queue->count;
    pthread_mutex_unlock(&row_queue->mutex);
    return count;
}

uint64_t md_row_queue_dropped(struct md_row_queue *row_queue)
{
    pthread_mutex_lock(&row_queue->mutex);
    uint64_t dropped = row_queue->dropped;
    pthread_mutex_unlock(&row_queue->mutex);
    return dropped;
}

/* ---- calls ---- */

void md_row_queue_call(struct md_row_queue *row_queue, uint32_t number)
{
    pthread_mutex_lock(&row_queue->mutex);
    row_queue->called[number / 64] |= UINT64_C(1) << number % 64;
    row_queue->least = number < row_queue->least ? number : row_queue->least;
    row_queue->most = number > row_queue->most ? number : row_queue->most;
    pthread_cond_signal(&row_queue->called_up);
    pthread_mutex_unlock(&row_queue->mutex);
}

static int take_calls(struct md_row_queue *row_queue, uint32_t *numbers, int room)
{
    int n = 0;
    uint32_t number = row_queue->least;
    for (; number <= row_queue->most && n < room; number++) {
        uint64_t bit = UINT64_C(1) << number % 64;
        if (row_queue->called[number / 64] & bit)
            numbers[n++] = number;
        row_queue->called[number / 64] &= ~bit;
    }
    row_queue->least = number;
    if (number > row_queue->most) {
        row_queue->least = MD_MOST_NUMBERS;
        row_queue->most = 0;
    }
    return n;
}

int md_row_queue_await(struct md_row_queue *row_queue, int64_t timeout_ns, uint32_t *numbers, int room)
{
    int64_t until_ns = md_now_ns() + timeout_ns;
    pthread_mutex_lock(&row_queue->mutex);
    while (row_queue->least > row_queue->most && wait_until(&row_queue->called_up, &row_queue->mutex, until_ns) == 0)
        ;
    int n = take_calls(row_queue, numbers, room);
    pthread_mutex_unlock(&row_queue->mutex);
    return n;
}
