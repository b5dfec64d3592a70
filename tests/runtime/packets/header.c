/* The public header needs nothing before it. */
#include "upbeam/packets.h"

extern int packets_header_compiles;
int packets_header_compiles = (int)sizeof(upb_firing);
