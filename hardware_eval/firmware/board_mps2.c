/* Arm MPS2 with the Cortex-M3 image AN385, which QEMU emulates: the host at UART 0, the bus at
 * UART 1, time from the FPGA's counter, SysTick to wake at an instant, and a watchdog whose interrupt
 * cannot be masked. */
#include <stdbool.h>

#include "board.h"

enum {
    CLOCK = 25,  /* MHz */
    BYTE_PATIENCE = 500, /* us: a byte takes 87 at the host's speed */
    RING = 1024, /* bytes that a line holds, a power of two */
    TX_FULL = 1,
    RX_FULL = 2,
    ENABLE_RX = 2 | 8, /* with its interrupt */
    ENABLE_TX = 1
};

struct uart {
    volatile uint32_t data, state, control, interrupt, divider;
};

struct watchdog {
    volatile uint32_t load, value, control, clear;
};

struct systick {
    volatile uint32_t control, reload, value;
};

/* Bytes that an interrupt has taken and the program has not. */
struct ring {
    volatile uint32_t head, tail;
    volatile uint8_t bytes[RING];
};

#define UART(line) ((struct uart *)(0x40004000u + 0x1000u * (line)))
#define WATCHDOG ((struct watchdog *)0x40008000u)
#define SYSTICK ((struct systick *)0xE000E010u)
#define COUNTER (*(volatile uint32_t *)0x40028018u)
#define PRESCALE (*(volatile uint32_t *)0x4002801Cu)
#define NVIC_ENABLE (*(volatile uint32_t *)0xE000E100u)

extern uint32_t data_load[], data_begin[], data_end[], bss_begin[], bss_end[];

int main(void);
void reset(void);

const char board_name[] = "firmware on MPS2 AN385";

static struct ring rings[2];

/* Fills memory and starts the program; the first that runs. */
void reset(void)
{
    const uint32_t *from = data_load;
    for (uint32_t *to = data_begin; to < data_end; to++)
        *to = *from++;
    for (uint32_t *to = bss_begin; to < bss_end; to++)
        *to = 0;
    main();
}

/* The watchdog or a fault: vents, and waits for the watchdog to reset the board. */
static void lost(void)
{
    board_lost();
    for (;;)
        ;
}

/* The instant has come for which the board waits: it is awake. */
static void tick(void)
{
}

/* Takes a byte of a line into its ring; a full ring loses it. */
static void received(enum board_line line)
{
    struct ring *ring = &rings[line];
    UART(line)->interrupt = RX_FULL; /* first: the next byte may come once this one is read */
    uint8_t byte = (uint8_t)UART(line)->data;
    if (ring->head - ring->tail < RING)
        ring->bytes[ring->head++ % RING] = byte;
}

static void received_host(void)
{
    received(BOARD_HOST);
}

static void received_bus(void)
{
    received(BOARD_BUS);
}

/* Vectors behind the stack's, which the linker puts first. */
__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    reset,       /* 1 */
    lost,        /* 2: the watchdog's, cannot be masked */
    lost,        /* 3: hard fault */
    lost,        /* 4: memory */
    lost,        /* 5: bus */
    lost,        /* 6: usage */
    0,           /* 7 */
    0,           /* 8 */
    0,           /* 9 */
    0,           /* 10 */
    lost,        /* 11 */
    lost,        /* 12 */
    0,           /* 13 */
    lost,        /* 14 */
    tick,        /* 15: SysTick */
    received_host, /* 16: UART 0 */
    lost,        /* 17 */
    received_bus /* 18: UART 1 */
};

void board_start(void)
{
    for (unsigned line = BOARD_HOST; line <= BOARD_BUS; line++) {
        UART(line)->divider = CLOCK * 1000000 / 115200;
        UART(line)->control = ENABLE_RX | ENABLE_TX;
    }
    PRESCALE = CLOCK - 1; /* counts microseconds */
    NVIC_ENABLE = 1u << 0 | 1u << 2;
    WATCHDOG->load = CLOCK * BOARD_PATIENCE;
    WATCHDOG->control = 3; /* interrupt, then reset */
}

uint64_t board_now(void)
{
    static uint32_t last, wraps;
    uint32_t count = COUNTER;
    if (count < last)
        wraps++; /* every 71 minutes */
    last = count;
    return (uint64_t)wraps << 32 | count;
}

/* Whether bytes have arrived. */
static bool waiting(void)
{
    return rings[0].head != rings[0].tail || rings[1].head != rings[1].tail;
}

void board_wait(uint64_t instant)
{
    uint64_t now;
    while (!waiting() && (now = board_now()) < instant) {
        SYSTICK->reload = (uint32_t)(instant - now) * CLOCK;
        SYSTICK->value = 0;
        SYSTICK->control = 7; /* on, with its interrupt, by the processor's clock */
        __asm volatile("cpsid i" ::: "memory"); /* so that no byte comes between look and sleep */
        if (!waiting())
            __asm volatile("wfi");
        __asm volatile("cpsie i" ::: "memory");
    }
    SYSTICK->control = 0;
}

void board_alive(void)
{
    WATCHDOG->clear = 1;
}

size_t board_read(enum board_line line, uint8_t *data, size_t room)
{
    struct ring *ring = &rings[line];
    size_t length = 0;
    while (length < room && ring->tail != ring->head)
        data[length++] = ring->bytes[ring->tail++ % RING];
    return length;
}

void board_write(enum board_line line, const uint8_t *data, size_t length)
{
    while (length--) {
        uint64_t until = board_now() + BYTE_PATIENCE;
        while (UART(line)->state & TX_FULL)
            if (board_now() > until)
                return; /* nobody takes it: lost, as on a wire; the guard must go on */
        UART(line)->data = *data++;
    }
}
