/* Count failed checks. Place copies of bytes directly before an unreadable page, so that an over-read crashes
 * the test even without sanitizers. */
#ifndef CHECKS_H
#define CHECKS_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#define COUNT(table) (sizeof(table) / sizeof *(table))
#define CHECK(truth) (checks++, (truth) ? 1 \
                      : (failures++, printf("%s:%d: %s: %s\n", __FILE__, __LINE__, row, #truth), 0))

static int checks, failures;
static const char *row = ""; /* name of the current check, for the report */

static inline uint8_t *page_end(void)
{
    static uint8_t *end;
    if (!end) {
        size_t page = (size_t)sysconf(_SC_PAGESIZE);
        uint8_t *pages = mmap(NULL, 2 * page, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        if (pages == MAP_FAILED || mprotect(pages + page, page, PROT_NONE))
            exit(2);
        end = pages + page;
    }
    return end;
}

static inline const uint8_t *at_the_edge(const uint8_t *bytes, size_t len)
{
    return len ? memcpy(page_end() - len, bytes, len) : page_end();
}

static int end_of_checks(void)
{
    printf("%d checks, %d failures\n", checks, failures);
    return failures != 0;
}

#endif
