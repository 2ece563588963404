/* What the program needs of a board: a clock, a line to the host, and a bus to sensors and valves. */
#ifndef BOARD_H
#define BOARD_H

#include <stddef.h>
#include <stdint.h>

enum board_line { BOARD_HOST, BOARD_BUS };

/* Name that the device tells. */
extern const char board_name[];

/* Starts clock, lines, and what resets a board that stands still. */
void board_start(void);

/* Time since the start, us. */
uint64_t board_now(void);

/* Returns at an instant, or when bytes have arrived. */
void board_wait(uint64_t instant);

/* Says that the program goes on. A board that is not told for BOARD_PATIENCE calls board_lost. */
void board_alive(void);

/* Takes what has arrived; never waits. */
size_t board_read(enum board_line line, uint8_t *data, size_t room);

/* Sends bytes. */
void board_write(enum board_line line, const uint8_t *data, size_t length);

/* Called by the board, from an interrupt, when the program stands still: vents. */
void board_lost(void);

enum { BOARD_PATIENCE = 50000 /* us */ };

#endif
