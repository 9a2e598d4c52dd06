/* Feed a Modbus TCP connection with any bytes in any pieces at any time.
 *
 * An input is a header (match transaction ids or not, time-outs) and steps: an exchange starts, time
 * passes, or bytes come. An accepted reply must have come on this connection. If transaction ids are matched,
 * it must have the request's id. */
#include "fuzz.h"

#include <errno.h>

enum { HEADER = 2, MOST = 4096, DRIVES = 2 };

enum step { BEGIN, PASS, END, COMES, STEPS };

struct scene {
    struct md_line line;
    struct md_completion done;
    struct md_drive drives[DRIVES];
    struct md_history histories[DRIVES];
    struct md_exchange exchange;
    int is_under_way;
    int64_t now;
    uint8_t heard[2 * MOST]; /* bytes received since the connection was made */
    size_t len;
};

static struct scene scene;

static void connect(uint8_t transactions)
{
    struct md_tap *tap = scene.line.tap;
    md_line_init(&scene.line, scene.now);
    scene.line.transactions = transactions;
    scene.line.tap = tap;
    scene.len = 0;
}

static int was_heard(const uint8_t *bytes, size_t len)
{
    for (size_t at = 0; at + len <= scene.len; at++)
        if (memcmp(scene.heard + at, bytes, len) == 0)
            return 1;
    return 0;
}

static void check_end(void)
{
    const struct md_completion *done = &scene.done;
    struct md_message again;
    must(scene.line.state == MD_IDLE && done->raw_len <= sizeof done->raw);
    if (done->result > 0) {
        must(done->sent_ns && done->raw_len == done->result);
        const struct md_message *request = &scene.exchange.request;
        must(md_parse_reply(MD_TCP, done->raw, done->raw_len, request, &again) == done->result);
        must(again.transaction == done->reply.transaction && again.exception == done->reply.exception);
        must(again.exception != 0x0A && again.exception != 0x0B);
        must(scene.line.transactions == MD_IGNORED || again.transaction == scene.line.transaction);
        must(was_heard(done->raw, done->raw_len));
    } else {
        must(done->result < 0 && done->reply.address == 0);
    }
    scene.is_under_way = 0;
}

static void want(void)
{
    for (int wants = 0; scene.is_under_way && wants < 8; wants++) {
        int wanted = md_line_want(&scene.line, scene.now);
        must(scene.line.rx_len <= sizeof scene.line.rx && scene.line.frame_len < sizeof scene.line.frame);
        if (wanted == MD_DONE)
            check_end();
        else if (wanted == MD_WRITE)
            md_line_sent(&scene.line, scene.line.tx_len, scene.now, scene.now);
        else if (wanted == MD_WAIT || scene.line.wake_ns > scene.now)
            return;
    }
}

static void begin(const uint8_t *bytes)
{
    if (scene.is_under_way)
        return;
    struct md_message request = request_of(bytes);
    scene.exchange = (struct md_exchange){.framing = MD_TCP, .request = request, .character_ns = 1,
                                          .drive = &scene.drives[request.address % DRIVES]};
    scene.is_under_way = 1;
    md_line_begin(&scene.line, &scene.exchange, &scene.done, scene.now);
    want();
}

static void hear(const uint8_t *bytes, size_t len)
{
    for (size_t i = 0; i < len && scene.len < sizeof scene.heard; i++) {
        scene.heard[scene.len++] = bytes[i];
        md_line_received(&scene.line, bytes + i, 1, scene.now);
        if (scene.line.is_out_of_step) {
            if (scene.is_under_way)
                md_line_abandon(&scene.line, MD_LINE_LOST, EPROTO);
            if (scene.is_under_way)
                check_end();
            connect(scene.line.transactions);
        }
        if (scene.is_under_way && scene.line.state == MD_IDLE)
            check_end();
    }
}

/* Make one step; return the number of its bytes in the input, 0 at the end. */
static size_t act(const uint8_t *step, size_t left)
{
    size_t len;
    switch (step[0] % STEPS) {
    case BEGIN:
        if (left < 1 + REQUEST_BYTES)
            return 0;
        begin(step + 1);
        return 1 + REQUEST_BYTES;
    case PASS:
        scene.now += left < 2 ? 0 : step[1];
        want();
        return 2;
    case END:
        if (scene.is_under_way && scene.line.wake_ns > scene.now)
            scene.now = scene.line.wake_ns;
        want();
        return 1;
    default:
        len = left < 2 ? 0 : step[1] < left - 2 ? step[1] : left - 2;
        hear(step + 2, len);
        want();
        return 2 + len;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size < HEADER || size > MOST)
        return 0;
    static uint8_t ring[1 << 12];
    static struct md_tap tap;
    memset(&scene, 0, sizeof scene);
    tap = (struct md_tap){.ring = ring, .room = sizeof ring};
    scene.now = 1000;
    for (int i = 0; i < DRIVES; i++)
        scene.drives[i] = (struct md_drive){.least_timeout_ns = 1 + data[1],
                                            .most_timeout_ns = 1 + 4 * data[1],
                                            .history = &scene.histories[i]};
    scene.line.tap = &tap;
    connect(data[0] & 1 ? MD_IGNORED : MD_MATCHED);
    size_t used;
    for (size_t at = HEADER; at < size; at += used) {
        used = act(data + at, size - at);
        if (used == 0)
            break;
    }
    for (int steps = 0; scene.is_under_way; steps++) { /* without further bytes, the exchange must end */
        must(steps < 16);
        scene.now = later(scene.now, scene.line.wake_ns);
        want();
    }
    return 0;
}

/* Select received bytes, as the reply to the request before them. Their transaction id is kept. */
int find_wire(uint8_t *data, size_t size, unsigned seed, struct wire *wire)
{
    size_t found = 0, at = HEADER, used = 0;
    struct md_message request = {0};
    uint16_t begun = 0;
    for (; at < size; at += used) {
        int step = data[at] % STEPS;
        used = step == BEGIN ? 1 + REQUEST_BYTES : step == PASS ? 2 : 1;
        if (step == BEGIN && at + used <= size) {
            request = request_of(data + at + 1);
            begun++;
        }
        if (step != COMES)
            continue;
        if (at + 2 > size)
            break;
        size_t len = data[at + 1] < size - at - 2 ? data[at + 1] : size - at - 2;
        used = 2 + len;
        if (found++ && (seed >> 8) % found) /* select each with equal probability */
            continue;
        if (len >= 2 && (seed & 12))
            md_put16(data + at + 2, begun);
        *wire = (struct wire){.at = at + 2, .len = len, .length_at = at + 1, .framing = MD_TCP,
                              .is_reply = begun && (seed & 3), .request = request};
    }
    return found > 0;
}
