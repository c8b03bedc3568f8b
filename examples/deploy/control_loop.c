/* A control loop in C: read sensors, run the policy, drive actuators, at a fixed rate.
 *
 *     csac train Pendulum-v1 --steps 20000 --warmup-steps 1000 --directory runs/swing
 *     csac export runs/swing --format c --fallback zero
 *     cc -std=c99 -O2 -I runs/swing/export/c examples/deploy/control_loop.c -o control_loop -lm
 *     ./control_loop < observations.txt > actions.txt
 *
 * Here sensors and actuators are standard input and output, one line per step. For a robot, replace read_sensors and
 * drive_actuators; the rest stays.
 */
#define _POSIX_C_SOURCE 200112L
#include <stdbool.h>
#include <stdio.h>
#include <time.h>

#include "policy.h"

#ifndef CSAC_CONTROL_RATE_HZ
#define CSAC_CONTROL_RATE_HZ 100.0f /* if the task states no rate; use the rate of training */
#endif

static bool read_sensors(float observation[CSAC_OBSERVATIONS])
{
    for (int i = 0; i < CSAC_OBSERVATIONS; i++)
        if (scanf("%f", &observation[i]) != 1) /* "nan" is valid: a failed sensor, which the guard handles */
            return false;
    return true;
}

static void drive_actuators(const float action[CSAC_ACTIONS])
{
    for (int i = 0; i < CSAC_ACTIONS; i++)
        printf("%.9g%c", (double)action[i], i + 1 < CSAC_ACTIONS ? ' ' : '\n');
    fflush(stdout);
}

static struct timespec later(struct timespec time, long nanoseconds)
{
    time.tv_nsec += nanoseconds;
    time.tv_sec += time.tv_nsec / 1000000000;
    time.tv_nsec %= 1000000000;
    return time;
}

static void sleep_until(struct timespec due)
{
#ifdef TIMER_ABSTIME
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
#else /* macOS cannot sleep until a given time, only for a duration */
    struct timespec now, wait;
    clock_gettime(CLOCK_MONOTONIC, &now);
    wait.tv_sec = due.tv_sec - now.tv_sec;
    wait.tv_nsec = due.tv_nsec - now.tv_nsec;
    if (wait.tv_nsec < 0) {
        wait.tv_sec--;
        wait.tv_nsec += 1000000000;
    }
    if (wait.tv_sec >= 0)
        nanosleep(&wait, NULL);
#endif
}

int main(void)
{
    static csac_state state = CSAC_INITIAL; /* memory of the guards; call csac_reset(&state) when an episode begins */
    float observation[CSAC_OBSERVATIONS], action[CSAC_ACTIONS];
    const long period = (long)(1e9f / CSAC_CONTROL_RATE_HZ);
    long steps = 0, missed = 0;
    struct timespec due, now;

    clock_gettime(CLOCK_MONOTONIC, &due);
    while (read_sensors(observation)) {
        csac_step(&state, observation, action);
        drive_actuators(action);
        steps++;

        due = later(due, period);
        clock_gettime(CLOCK_MONOTONIC, &now);
        if (now.tv_sec > due.tv_sec || (now.tv_sec == due.tv_sec && now.tv_nsec > due.tv_nsec)) {
            missed++;
            due = now; /* continue from now: do not shorten later steps to catch up */
        } else
            sleep_until(due);
    }
    /* Actuators hold the last action until they get another: on a robot, command a safe action here. */
    fprintf(stderr, "%ld steps at %g Hz, %ld of them too late\n", steps, (double)CSAC_CONTROL_RATE_HZ, missed);
    return 0;
}
