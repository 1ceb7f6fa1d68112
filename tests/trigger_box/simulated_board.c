/* An ATmega328P in simavr that runs a program: each line of the standard input is sent to its serial line, and answered
   by what comes back, how often the pins 2, 3, 5, 6, 7, 8 rose, how long pin 2 was up and how long after the first pin
   the last one rose, in microseconds. */

#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdio.h>
#include <string.h>

#define MHZ 16

static avr_t *avr;
static char heard[1000];
static int size, rises[9];
static avr_cycle_count_t up[9], first, last;
static double width;

static void hear(struct avr_irq_t *irq, uint32_t value, void *nothing) {
    if (size < (int)sizeof heard - 1) heard[size++] = value == '\n' ? 0 : value;
}

static void watch(struct avr_irq_t *irq, uint32_t value, void *number) {
    long pin = (long)number;
    if (value) {
        rises[pin]++, up[pin] = last = avr->cycle;
        if (!first) first = avr->cycle;
    } else if (pin == 2 && up[pin]) width = (double)(avr->cycle - up[pin]) / MHZ;
}

static void run(double milliseconds) {
    avr_cycle_count_t end = avr->cycle + milliseconds * 1000 * MHZ;
    while (avr->cycle < end) avr_run(avr);
}

int main(int count, char **words) {
    elf_firmware_t firmware = {{0}};
    if (count < 2 || elf_read_firmware(words[1], &firmware)) return 1;
    avr = avr_make_mcu_by_name("atmega328p");
    firmware.frequency = MHZ * 1000000;
    avr_init(avr);
    avr_load_firmware(avr, &firmware);
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~AVR_UART_FLAG_STDIO;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_t *in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), hear, NULL);
    for (long pin = 2; pin < 9; pin++)
        avr_irq_register_notify(avr_io_getirq(avr, pin < 8 ? AVR_IOCTL_IOPORT_GETIRQ('D') : AVR_IOCTL_IOPORT_GETIRQ('B'), pin % 8),
                                watch, (void *)pin);
    run(50);
    for (char line[100]; fgets(line, sizeof line, stdin);) {
        size = 0, first = last = 0, width = 0;
        memset(rises, 0, sizeof rises), memset(heard, 0, sizeof heard);
        for (char *letter = line; *letter; letter++) avr_raise_irq(in, *letter), run(0.2);
        run(20);
        printf("%s|%d %d %d %d %d %d|%.1f|%.1f\n", heard, rises[2], rises[3], rises[5], rises[6], rises[7], rises[8], width,
               (double)(last - first) / MHZ);
    }
    return 0;
}
