/* Times single steps of policy.h, flat out or at a fixed rate, by a clock that is read right before and after each. */
#define _POSIX_C_SOURCE 200112L
#include <errno.h>
#include <stdint.h>
#include <time.h>

#include "policy.h"

static csac_state state = CSAC_INITIAL;
static volatile float sink[CSAC_ACTIONS]; /* without a reader, a compiler would leave out the steps */

static int64_t now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

static void sleep_until(int64_t due)
{
    struct timespec time;
#ifdef TIMER_ABSTIME
    time.tv_sec = (time_t)(due / 1000000000);
    time.tv_nsec = (long)(due % 1000000000);
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &time, 0) == EINTR) {
    }
#else /* macOS sleeps for a while only, not until a time */
    int64_t wait;
    while ((wait = due - now()) > 0) {
        time.tv_sec = (time_t)(wait / 1000000000);
        time.tv_nsec = (long)(wait % 1000000000);
        if (nanosleep(&time, 0) && errno != EINTR)
            return;
    }
#endif
}

/* Nanoseconds of each of so many calls, on `count` observations in turn. With a period, each waits until it is due:
 * `lateness` is how long after that it began. The first is due a period after `due`, or after now where that is 0.
 * Returns when the last was due, for the calls after it. */
int64_t latency_measure(const float *observations, int64_t count, int64_t calls, int64_t period, int64_t *durations,
                        int64_t *lateness, int64_t due)
{
    float action[CSAC_ACTIONS];
    if (!due)
        due = now();
    for (int64_t call = 0; call < calls; call++) {
        int64_t began, ended;
        due += period;
        if (period)
            sleep_until(due);
        began = now();
        csac_step(&state, observations + (call % count) * CSAC_OBSERVATIONS, action);
        ended = now();
        for (int i = 0; i < CSAC_ACTIONS; i++)
            sink[i] = action[i];
        durations[call] = ended - began;
        lateness[call] = period ? began - due : 0;
    }
    return due;
}
