/* Sockets, the console's tty, and files of upbeamd. What fails is told on standard error, with the reason. */
#ifndef UPBEAMD_NETWORK_H
#define UPBEAMD_NETWORK_H

#include <netinet/in.h>
#include <stddef.h>
#include <stdint.h>

/* "address:port". 0: it is none. */
int parse_endpoint(const char *text, struct sockaddr_in *to);
/* A UDP socket bound to `at`, non-blocking; -1: told. */
int udp_bound(const struct sockaddr_in *at);
/* A UDP socket connected to `to`, non-blocking; -1: told. */
int udp_connected(const struct sockaddr_in *to);
/* Asks for a receive buffer; what the system gave, bytes. */
uint32_t udp_receive_buffer(int fd, uint32_t bytes);
/* A tty, raw, 8N1, non-blocking; -1: told. */
int tty_open(const char *path, uint32_t baud);

/* A whole file in memory of malloc(), at most `most` bytes; null: told. */
uint8_t *file_read(const char *path, size_t most, size_t *bytes);
/* Whole or not at all: written beside it, then renamed. 0: failed. */
int file_replace(const char *path, const void *content, size_t bytes);

#endif /* UPBEAMD_NETWORK_H */
