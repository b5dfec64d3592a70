#define _GNU_SOURCE
#include "network.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <unistd.h>

int parse_endpoint(const char *text, struct sockaddr_in *to) {
    char host[64];
    const char *colon = strrchr(text, ':');
    if (!colon || (size_t)(colon - text) >= sizeof host)
        return 0;
    memcpy(host, text, (size_t)(colon - text));
    host[colon - text] = '\0';
    char *end;
    const unsigned long port = strtoul(colon + 1, &end, 10);
    memset(to, 0, sizeof *to);
    to->sin_family = AF_INET;
    to->sin_port = htons((uint16_t)port);
    return end != colon + 1 && *end == '\0' && port <= 65535 && inet_pton(AF_INET, host, &to->sin_addr) == 1;
}

static int told(int fd, const char *what) {
    fprintf(stderr, "upbeamd: %s: %s\n", what, strerror(errno));
    if (fd >= 0)
        close(fd);
    return -1;
}

static int udp_socket(void) {
    const int fd = socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    return fd < 0 ? told(fd, "socket") : fd;
}

int udp_bound(const struct sockaddr_in *at) {
    const int fd = udp_socket(), yes = 1;
    if (fd < 0)
        return -1;
    setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
    if (bind(fd, (const struct sockaddr *)at, sizeof *at) != 0)
        return told(fd, "bind");
    return fd;
}

int udp_connected(const struct sockaddr_in *to) {
    const int fd = udp_socket();
    if (fd >= 0 && connect(fd, (const struct sockaddr *)to, sizeof *to) != 0)
        return told(fd, "connect");
    return fd;
}

uint32_t udp_receive_buffer(int fd, uint32_t bytes) {
    const int asked = bytes > INT32_MAX ? INT32_MAX : (int)bytes;
    int got = 0;
    socklen_t size = sizeof got;
    if (setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &asked, sizeof asked) != 0 ||
        getsockopt(fd, SOL_SOCKET, SO_RCVBUF, &got, &size) != 0)
        return 0;
#ifdef __linux__
    got /= 2; /* Linux doubles what it was asked for, and tells that */
#endif
    return (uint32_t)got;
}

static speed_t speed_of(uint32_t baud) {
    switch (baud) {
    case 9600:
        return B9600;
    case 115200:
        return B115200;
    case 230400:
        return B230400;
    case 460800:
        return B460800;
    case 921600:
        return B921600;
    default:
        return B0;
    }
}

int tty_open(const char *path, uint32_t baud) {
    struct termios line;
    const speed_t speed = speed_of(baud);
    if (speed == B0) {
        fprintf(stderr, "upbeamd: serial_baud %u, expected 9600, 115200, 230400, 460800 or 921600\n", baud);
        return -1;
    }
    const int fd = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (fd < 0 || tcgetattr(fd, &line) != 0)
        return told(fd, path);
    cfmakeraw(&line);
    line.c_cflag |= CLOCAL | CREAD;
    if (cfsetispeed(&line, speed) != 0 || cfsetospeed(&line, speed) != 0 || tcsetattr(fd, TCSANOW, &line) != 0)
        return told(fd, path);
    return fd;
}

uint8_t *file_read(const char *path, size_t most, size_t *bytes) {
    FILE *file = fopen(path, "rb");
    if (!file) {
        told(-1, path);
        return NULL;
    }
    uint8_t *content = malloc(most + 2);
    *bytes = content ? fread(content, 1, most + 1, file) : 0;
    const int failed = ferror(file);
    fclose(file);
    if (!content || failed || *bytes > most) {
        fprintf(stderr, "upbeamd: %s: %s\n", path, *bytes > most ? "larger than allowed" : "cannot be read");
        free(content);
        return NULL;
    }
    content[*bytes] = 0; /* so that text ends */
    return content;
}

int file_replace(const char *path, const void *content, size_t bytes) {
    char beside[4096];
    if (snprintf(beside, sizeof beside, "%s.new", path) >= (int)sizeof beside)
        return 0;
    const int fd = open(beside, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (fd < 0)
        return 0;
    const uint8_t *at = content;
    while (bytes) {
        const ssize_t written = write(fd, at, bytes);
        if (written < 0 && errno == EINTR)
            continue;
        if (written <= 0)
            break;
        at += written;
        bytes -= (size_t)written;
    }
    const int good = bytes == 0 && fsync(fd) == 0;
    return close(fd) == 0 && good && rename(beside, path) == 0;
}
