/* What is asked before an exchange: proofs that no late answer is taken for its reply, and then, where it is
 * unknown whether the adapter echoes, a question whose reply is never a copy of it. */
#include "internal.h"

enum { MOST_PROOFS_ASKED = 12 };

static uint64_t heard(const struct md_drive *drive)
{
    return drive->counters.answered + drive->counters.late;
}

const struct md_exchange *md_before(struct md_before *before, const struct md_exchange *exchange, int echo, int64_t now_ns)
{
    if (before->then != exchange)
        *before = (struct md_before){.then = exchange, .failures = exchange->drive->failures};
    const struct md_exchange *proof = md_late_proof(exchange, now_ns);
    int has_helped = before->proofs == 0 || heard(exchange->drive) != before->heard;
    if (proof && has_helped && before->proofs < MOST_PROOFS_ASKED) {
        before->proofs++;
        before->heard = heard(exchange->drive);
        return proof;
    }
    if (!exchange->echo_probe || echo != MD_ECHO_UNKNOWN || before->is_told)
        return NULL;
    before->is_told = 1;
    return exchange->echo_probe;
}

/* A write never is: it may have started a motor. */
int md_is_asked_again(struct md_before *before, const struct md_exchange *exchange, const struct md_completion *completion)
{
    int is_in_doubt = completion->result == MD_LATE_ANSWER_DUE && completion->sent_ns;
    if (is_in_doubt && md_is_read(exchange->framing, exchange->request.function) && before->proofs < MOST_PROOFS_ASKED)
        return 1;
    before->then = NULL;
    return 0;
}
