/* A Linux computer: the host at standard input and output, the bus at the descriptor that the
 * variable VENTILATOR_BUS names. Nothing resets it: a supervisor must. It ends, vented, when either
 * line ends. */
#define _POSIX_C_SOURCE 200809L

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include "board.h"

const char board_name[] = "firmware on Linux";

static uint64_t begun;
static int bus = 3;

/* Time of the system, us. */
static uint64_t monotonic(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

void board_start(void)
{
    const char *given = getenv("VENTILATOR_BUS");
    begun = monotonic();
    bus = given ? atoi(given) : bus;
    fcntl(STDIN_FILENO, F_SETFL, fcntl(STDIN_FILENO, F_GETFL) | O_NONBLOCK);
    fcntl(bus, F_SETFL, fcntl(bus, F_GETFL) | O_NONBLOCK);
}

uint64_t board_now(void)
{
    return monotonic() - begun;
}

void board_wait(uint64_t instant)
{
    struct pollfd lines[] = {{.fd = STDIN_FILENO, .events = POLLIN}, {.fd = bus, .events = POLLIN}};
    uint64_t now = board_now();
    if (now < instant)
        poll(lines, 2, (int)((instant - now + 999) / 1000));
}

void board_alive(void)
{
}

size_t board_read(enum board_line line, uint8_t *data, size_t room)
{
    ssize_t length = read(line == BOARD_HOST ? STDIN_FILENO : bus, data, room);
    if (length > 0)
        return (size_t)length;
    if (length < 0 && (errno == EAGAIN || errno == EINTR))
        return 0;
    board_lost();
    exit(0);
}

void board_write(enum board_line line, const uint8_t *data, size_t length)
{
    while (length) {
        ssize_t sent = write(line == BOARD_HOST ? STDOUT_FILENO : bus, data, length);
        if (sent < 0)
            return; /* the line is full or gone: lost, as on a wire */
        data += sent;
        length -= (size_t)sent;
    }
}
