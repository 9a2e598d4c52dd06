/* Pass all inputs of a parser's corpus to its harness, without libFuzzer: `replay corpus.txt PARSER`. Each
 * line of the file is an input: its parser, its name, and its bytes in hex. */
#include "fuzz.h"

#include <ctype.h>
#include <string.h>

static int value_of(int digit)
{
    return isdigit(digit) ? digit - '0' : digit - 'a' + 10;
}

int main(int argc, char **argv)
{
    static uint8_t data[1 << 16];
    char parser[17], name[65];
    FILE *file = argc == 3 ? fopen(argv[1], "r") : NULL;
    if (!file) {
        fprintf(stderr, "usage: %s corpus.txt PARSER\n", argv[0]);
        return 2;
    }
    while (fscanf(file, "%16s %64s", parser, name) == 2) {
        size_t size = 0;
        int high, low;
        must(getc(file) == ' ');
        while (isxdigit(high = getc(file))) {
            low = getc(file);
            must(isxdigit(low) && size < sizeof data);
            data[size++] = (uint8_t)(value_of(high) << 4 | value_of(low));
        }
        must(high == '\n');
        if (strcmp(parser, argv[2]))
            continue;
        fprintf(stderr, "%s\n", name); /* if the harness aborts, the last printed name is the failing input */
        uint8_t *exact = exact_copy(data, size);
        LLVMFuzzerTestOneInput(exact, size);
        free(exact);
    }
    fclose(file);
    return 0;
}
