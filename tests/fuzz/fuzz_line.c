/* Feed the state machine of a line with any bytes at any time in any order.
 *
 * An input is a header (adapter, time-outs) and steps: an exchange starts, time passes, the port takes
 * bytes or fails, noise comes, or a drive's reply comes: immediately, late, in pieces, damaged, doubled, or
 * never. The value in a reply is the number of its exchange, so the harness detects a reply that is accepted
 * for another exchange. A character takes 1 ns, so that all times are small. */
#include "fuzz.h"

#include <errno.h>

enum { HEADER = 4, MOST = 4096, DRIVES = 4, HEARD = 1 << 15, ANSWERS = 16, MOST_WANTS = 6, NOISE = -1,
      ECHO = -2, FLOOD = 700 };

enum step { BEGIN, PASS, WAKE, TAKE, NOISE_COMES, ANSWER_COMES, PIECE_COMES, PORT_FAILS, STEPS };

/* A reply that a drive will send. */
struct answer {
    int exchange;     /* number of the exchange; 0: this entry is free */
    int64_t until_ns; /* the latest time at which the reply may come */
    size_t len, at;
    uint8_t bytes[MD_MOST_FRAME];
};

struct scene {
    struct md_line line;
    struct md_completion *done; /* freed when the exchange ends, so that later accesses are detected */
    struct md_drive drives[DRIVES];
    struct md_history histories[DRIVES];
    struct md_exchange exchange;
    int is_under_way, has_asked, adapter_echoes, is_spoiled;
    int number; /* number of the exchange */
    int64_t now, begun, ends; /* present time; start of the exchange; its latest end */
    int64_t last_heard, silence; /* last activity on the line, and the silence required after it */
    /* number of bytes received before the exchange, in the exchange before its request, and after its request
     * */
    size_t left_over, before, after;
    struct answer answers[ANSWERS];
    uint64_t exchanges[DRIVES];
    int16_t origin[HEARD]; /* for each byte after the request: the exchange whose reply has it */
    uint8_t heard[HEARD];
    struct md_tap tap;
    /* how often each byte value was on the line: according to the tap, and in fact */
    uint32_t told[256], passed[256];
};

static struct scene scene;

static int drive_of(const struct md_message *request)
{
    return request->address % DRIVES;
}

static struct answer *answer_to(int number)
{
    for (int i = 0; i < ANSWERS; i++)
        if (scene.answers[i].exchange == number)
            return &scene.answers[i];
    return NULL;
}

/* ---- invariants ---- */

static void check_line(void)
{
    const struct md_line *line = &scene.line;
    must(line->rx_from <= line->rx_len && line->rx_len <= sizeof line->rx && line->tx_at <= line->tx_len);
    must(line->tx_len <= MD_MOST_FRAME);
}

static int is_read(const struct md_message *request)
{
    return request->function <= 0x04;
}

/* Check that at least one byte of `raw` is from the drive's reply to the present exchange. */
static void check_origin(const uint8_t *raw, size_t len)
{
    int is_own = 0;
    for (size_t at = 0; at + len <= scene.after; at++)
        for (size_t i = 0; i < len && memcmp(scene.heard + at, raw, len) == 0; i++)
            is_own |= scene.origin[at + i] == scene.number;
    must(is_own);
}

static int is_same(const struct md_message *one, const struct md_message *other)
{
    return one->address == other->address && one->function == other->function &&
        one->exception == other->exception &&
           one->start == other->start && one->count == other->count && one->data_len == other->data_len &&
           memcmp(one->data, other->data, one->data_len) == 0;
}

static void check_completion(void)
{
    const struct md_completion *done = scene.done;
    const struct md_exchange *exchange = &scene.exchange;
    size_t used = done->result > 0 ? (size_t)done->result : 0;
    must(done->begun_ns == scene.begun && done->raw_len <= sizeof done->raw);
    /* Every received byte is part of the accepted reply or counted. Bytes that come during sending may be an
     * echo. */
    must(done->stale + done->skipped + used == scene.left_over + scene.before + scene.after);
    must(done->skipped + used >= scene.after && done->skipped + used <= scene.after + scene.line.tx_len);
    must((done->sent_ns != 0) == scene.has_asked || done->result == MD_LINE_LOST);
    must((scene.after > 0) == (done->last_ns > 0) && done->first_ns <= done->last_ns &&
         done->last_ns <= scene.now);
    must(done->first_ns == 0 || done->sent_ns <= done->first_ns);
    must(done->sent_ns == 0 || done->begun_ns <= done->sent_ns);
    if (done->result > 0) {
        struct md_message again;
        must(scene.has_asked && done->raw_len == used);
        must(md_parse_reply(exchange->framing, done->raw, done->raw_len, &exchange->request,
                            &again) == done->result);
        must(is_same(&again, &done->reply));
        if (!scene.is_spoiled)
            check_origin(done->raw, done->raw_len);
    } else if (done->result == 0)
        must(exchange->request.address == 0 && scene.after == 0);
    else
        must((done->result >= MD_EXPIRED || done->result == MD_MAYBE_ECHO) && done->reply.address == 0);
    if (done->result == MD_NO_REPLY) /* `raw` may only have the request's echo */
        must(done->raw_len == 0 || done->raw_len == scene.line.tx_len);
}

static void check_counters(void)
{
    for (int i = 0; i < DRIVES; i++) {
        const struct md_counters *counters = &scene.drives[i].counters;
        const struct md_history *history = &scene.histories[i];
        uint64_t values = counters->values, ended = counters->answered, delays = 0;
        for (size_t reason = 0; reason < sizeof history->missed / sizeof *history->missed; reason++) {
            values += history->missed[reason];
            ended += history->ended[reason];
        }
        for (size_t code = 0; code < 256; code++)
            values += history->refused[code];
        for (size_t bucket = 0; bucket < MD_DELAY_BUCKETS; bucket++)
            delays += scene.drives[i].delays[bucket];
        must(counters->exchanges == scene.exchanges[i] && values == counters->exchanges &&
             ended == counters->exchanges);
        must(delays == counters->answered && counters->sent <= counters->exchanges);
        must(scene.drives[i].delay_ns >= 0 && scene.drives[i].deviation_ns >= 0);
    }
}

static uint32_t number(const uint8_t *at)
{
    return at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
}

/* Check that the tap has every sent and received byte, in complete packets. */
static void check_tap(void)
{
    enum { LEN_AT = 20, BYTES_AT = 28 };
    static struct md_wrapping bare[2 * MD_SIDES];
    static uint8_t packets[1 << 17];
    for (size_t i = 0; i < sizeof bare / sizeof *bare; i++)
        bare[i].head = bare[i].tail = (const uint8_t *)"";
    size_t used = md_tap_take(&scene.tap, bare, 0, 0, packets, sizeof packets);
    for (size_t at = 0; at < used; at += number(packets + at + 4)) {
        must(number(packets + at + number(packets + at + 4) - 4) == number(packets + at + 4));
        for (size_t i = 0; i < number(packets + at + LEN_AT); i++)
            scene.told[packets[at + BYTES_AT + i]]++;
    }
    must(scene.tap.lost == 0 && scene.tap.taken == scene.tap.put);
    must(memcmp(scene.told, scene.passed, sizeof scene.told) == 0);
}

/* ---- what happens ---- */

static void end(void)
{
    check_completion();
    scene.is_under_way = 0;
    int64_t turnaround = scene.done->result == 0 ? scene.exchange.turnaround_ns : 0;
    if (scene.done->sent_ns)
        scene.silence = turnaround > scene.exchange.silence_ns ? turnaround : scene.exchange.silence_ns;
    scene.exchanges[drive_of(&scene.exchange.request)]++;
    struct answer *late = answer_to(scene.number);
    if (late)
        late->until_ns = scene.exchange.drive->late_until_ns;
    scene.before = scene.after = 0;
    free(scene.done);
    check_counters();
    check_tap();
}

static void hear(const uint8_t *bytes, size_t len, int origin)
{
    int is_after = scene.is_under_way && scene.has_asked;
    for (size_t i = 0; is_after && i < len && scene.after + i < HEARD; i++) {
        scene.heard[scene.after + i] = bytes[i];
        scene.origin[scene.after + i] = (int16_t)origin;
    }
    must(scene.after + len < HEARD);
    scene.before += is_after ? 0 : len;
    scene.after += is_after ? len : 0;
    if (len && scene.last_heard < scene.now)
        scene.last_heard = scene.now;
    for (size_t i = 0; i < len; i++)
        scene.passed[bytes[i]]++;
    uint8_t *exact = exact_copy(bytes, len);
    md_line_received(&scene.line, exact, len, scene.now);
    free(exact);
    check_line();
}

/* Return the line's next action. If the line wants to read now, report that the port is empty and ask for the
 * next action again. If the exchange is done, end it. */
static int want(void)
{
    int wanted = MD_DONE;
    if (!scene.is_under_way)
        return wanted;
    for (int wants = 0; wants < MOST_WANTS; wants++) {
        wanted = md_line_want(&scene.line, scene.now);
        check_line();
        if (wanted == MD_READ && scene.line.wake_ns <= scene.now)
            continue;
        must(wanted == MD_DONE || scene.now < scene.ends || wanted == MD_WRITE);
        must((wanted != MD_WAIT && wanted != MD_READ) || scene.line.wake_ns > scene.now);
        if (wanted == MD_DONE)
            end();
        return wanted;
    }
    must(wanted == MD_DONE); /* otherwise the line would read the empty port forever */
    return wanted;
}

/* Return the longest time in ns that an exchange may take once its request can be sent. */
static int64_t longest(void)
{
    const struct md_exchange *exchange = &scene.exchange;
    const struct md_drive *drive = exchange->drive;
    int64_t most = drive->patience_ns > drive->most_timeout_ns ? drive->patience_ns : drive->most_timeout_ns;
    return 3 * most + (2 * MD_MOST_FRAME + md_longest_reply(exchange->framing,
                                                            &exchange->request)) * exchange->character_ns;
}

static void begin(const uint8_t *bytes, uint8_t silence, uint8_t turnaround)
{
    struct md_message request = request_of(bytes);
    if (want() != MD_DONE)
        return;
    request.address %= 8;
    scene.number++;
    scene.exchange = (struct md_exchange){.framing = bytes[0] % 3, .request = request, .character_ns = 1,
                                          .silence_ns = silence,
                                          .turnaround_ns = turnaround,
                                              .drive = &scene.drives[drive_of(&request)]};
    if (scene.number % 2) { /* for every second exchange, build the frame in advance, as planning does */
        uint8_t *frame = scene.exchange.frame;
        int len = md_build_request(scene.exchange.framing, &request, frame, MD_KEPT_FRAME);
        scene.exchange.frame_len = (uint8_t)(len > 0 ? len : 0);
    }
    scene.begun = scene.now;
    scene.has_asked = 0;
    scene.before = scene.after = 0;
    scene.left_over = scene.line.rx_len;
    scene.is_under_way = 1;
    if (scene.silence < silence)
        scene.silence = silence;
    int64_t free_from = scene.last_heard + scene.silence > scene.now ? scene.last_heard + scene.silence
        : scene.now;
    scene.ends = free_from + longest();
    must((scene.done = malloc(sizeof *scene.done)) != NULL);
    md_line_begin(&scene.line, &scene.exchange, scene.done, scene.now);
    want();
}

/* Fill the data of a reply that has no room for the number of the exchange. */
static void fill_short(struct md_message *reply)
{
    static const uint16_t lengths[] = {[0x07] = 1, [0x0B] = 4, [0x0C] = 1, [0x11] = 1, [0x16] = 4, [0x18] = 2,
                                       [0x2B] = 6};
    uint8_t code = reply->data[1];
    reply->data_len = reply->function < sizeof lengths / sizeof *lengths ? lengths[reply->function] : 0;
    if (reply->function == 0x16) /* repeats its request */
        return;
    memset(reply->data, 0, reply->data_len);
    if (reply->function == 0x2B) { /* a device identification without objects */
        reply->data[0] = 0x0E;
        reply->data[1] = code;
    }
}

/* The request was sent: add the drive's pending reply, whose value is the number of the exchange. */
static void ask(void)
{
    const struct md_message *request = &scene.exchange.request;
    struct answer *answer = answer_to(0);
    scene.has_asked = 1;
    if (!request->address || !answer)
        return;
    struct md_message reply = *request;
    if (scene.exchange.framing != MD_DELIXI && is_read(request)) {
        unsigned bits = request->function > 2 ? 16 : 1;
        reply.data_len = (uint16_t)((request->count * bits + 7) / 8);
        for (int i = 0; i < reply.data_len; i++)
            reply.data[i] = (uint8_t)(i % 2 ? scene.number : scene.number >> 8);
    } else if (scene.exchange.framing != MD_DELIXI && (request->function > 8 || request->function == 7))
        fill_short(&reply);
    else if (scene.exchange.framing == MD_DELIXI && request->function == 7)
        reply.data[3] = (uint8_t)scene.number;
    else if (scene.exchange.framing == MD_DELIXI && request->function == 3)
        reply.start = (uint16_t)(1 + scene.number % 8);
    int len = md_build_reply(scene.exchange.framing, &reply, answer->bytes, sizeof answer->bytes);
    must(len > 0);
    *answer = (struct answer){.exchange = scene.number, .len = (size_t)len};
    md_build_reply(scene.exchange.framing, &reply, answer->bytes, sizeof answer->bytes);
}

static void take(size_t most)
{
    if (want() != MD_WRITE)
        return;
    struct md_line *line = &scene.line;
    size_t left = (size_t)(line->tx_len - line->tx_at), len = most < left ? most : left;
    int is_babble = scene.now >= line->give_up_ns;
    must(is_babble || line->tx_at > 0 || scene.now - scene.last_heard >= scene.silence);
    uint8_t echo[MD_MOST_FRAME];
    memcpy(echo, line->tx + line->tx_at, len);
    int is_last = len == left && len > 0;
    if (is_last)
        ask();
    for (size_t i = 0; i < len; i++)
        scene.passed[echo[i]]++;
    md_line_sent(line, len, scene.now, scene.now);
    check_line();
    if (len && scene.last_heard < scene.now)
        scene.last_heard = scene.now;
    if (len)
        scene.last_heard += (int64_t)len * scene.exchange.character_ns;
    if (is_last)
        want();
    if (scene.adapter_echoes)
        hear(echo, len, ECHO);
    if (is_last)
        want();
}

/* Receive up to `most` bytes of a pending reply. Unless `flip` is 0, damage one byte by it. Drop a reply that
 * would come after its `until_ns`. */
static void let_answer(unsigned which, size_t most, uint8_t flip)
{
    struct answer *answer = NULL;
    for (unsigned i = 0; i < ANSWERS && !answer; i++)
        if (scene.answers[(which + i) % ANSWERS].exchange)
            answer = &scene.answers[(which + i) % ANSWERS];
    if (!answer)
        return;
    int is_due = scene.is_under_way && scene.number == answer->exchange;
    if (!is_due && scene.now >= answer->until_ns) {
        answer->exchange = 0;
        return;
    }
    size_t left = answer->len - answer->at, len = most < left ? most : left;
    uint8_t bytes[MD_MOST_FRAME];
    memcpy(bytes, answer->bytes + answer->at, len);
    if (flip && len)
        bytes[flip % len] ^= (uint8_t)(1u << flip % 8);
    int number = answer->exchange;
    answer->at += len;
    if (answer->at == answer->len)
        answer->exchange = 0;
    hear(bytes, len, number);
}

static void fail(int error)
{
    if (scene.is_under_way) {
        md_line_abandon(&scene.line, MD_LINE_LOST, error);
        must(md_line_want(&scene.line, scene.now) == MD_DONE);
        end();
    }
    memset(scene.answers, 0, sizeof scene.answers); /* pending replies are lost with the port */
}

/* Make one step; return the number of its bytes in the input, 0 at the end. */
static size_t act(const uint8_t *step, size_t left)
{
    static const uint8_t flood[FLOOD]; /* more than half of a line's buffer */
    size_t len;
    switch (step[0] % STEPS) {
    case BEGIN:
        if (left < 3 + REQUEST_BYTES)
            return 0;
        begin(step + 3, step[1], step[2]);
        return 3 + REQUEST_BYTES;
    case PASS:
        if (left < 2)
            return 0;
        scene.now += step[1];
        want();
        return 2;
    case WAKE:
        if (want() == MD_WAIT || (scene.is_under_way && scene.line.wake_ns > scene.now))
            scene.now = scene.line.wake_ns;
        want();
        return 1;
    case TAKE:
        take(left > 1 ? step[1] : 0);
        return 2;
    case NOISE_COMES:
        len = left < 2 ? 0 : step[1] < left - 2 ? step[1] : left - 2;
        for (size_t i = 0; i < len; i++)
            scene.is_spoiled |= step[2 + i] < 0xF8; /* the noise may be a frame, or a part of one */
        hear(step + 2, len, NOISE);
        if (len == 0 && scene.after + FLOOD < HEARD)
            hear(flood, FLOOD, NOISE);
        want();
        return 2 + len;
    case ANSWER_COMES:
    case PIECE_COMES:
        if (left < 3)
            return 0;
        let_answer(step[1], step[0] % STEPS == PIECE_COMES ? step[2] : MD_MOST_FRAME, step[0] & 0x80
                   ? step[2] : 0);
        want();
        return 3;
    default:
        fail(EIO);
        return 1;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size < HEADER || size > MOST)
        return 0;
    static uint8_t ring[1 << 16];
    memset(&scene, 0, sizeof scene);
    scene.tap = (struct md_tap){.ring = ring, .room = sizeof ring, .put = data[3] * 7919u,
                                .taken = data[3] * 7919u};
    scene.now = scene.last_heard = 1000;
    for (int i = 0; i < DRIVES; i++)
        scene.drives[i] = (struct md_drive){.least_timeout_ns = 1 + data[1],
                                            .most_timeout_ns = 1 + data[1] + 4 * data[2],
                                           .history = &scene.histories[i]};
    scene.adapter_echoes = data[3] & 1;
    md_line_init(&scene.line, scene.now);
    scene.line.tap = &scene.tap;
    size_t used;
    for (size_t at = HEADER; at < size; at += used)
        if ((used = act(data + at, size - at)) == 0)
            break;
    for (int steps = 0; want() != MD_DONE; steps++) { /* without further bytes, the exchange must end */
        must(steps < 16);
        if (md_line_want(&scene.line, scene.now) == MD_WRITE)
            take(MD_MOST_FRAME);
        else
            scene.now = scene.line.wake_ns;
    }
    return 0;
}

/* Select bytes of noise, which the mutator replaces by a frame: a request, or a reply to the last exchange
 * before it. */
int find_wire(uint8_t *data, size_t size, unsigned seed, struct wire *wire)
{
    size_t found = 0, at = HEADER, used = 0;
    struct md_message request = {0};
    int framing = -1;
    for (; at < size; at += used) {
        int step = data[at] % STEPS;
        used = step == BEGIN ? 3 + REQUEST_BYTES : step == PASS || step == TAKE ? 2 : step == ANSWER_COMES ||
            step == PIECE_COMES ? 3 : 1;
        if (step == BEGIN && at + used <= size) {
            framing = data[at + 3] % 3;
            request = request_of(data + at + 3);
            request.address %= 8;
        }
        if (step != NOISE_COMES)
            continue;
        if (at + 2 > size)
            break;
        size_t len = data[at + 1] < size - at - 2 ? data[at + 1] : size - at - 2;
        used = 2 + len;
        if (found++ && (seed >> 8) % found) /* select each with equal probability */
            continue;
        *wire = (struct wire){.at = at + 2, .len = len, .length_at = at + 1, .framing = framing,
                              .is_reply = framing >= 0 && (seed & 3), .request = request};
    }
    return found > 0;
}
