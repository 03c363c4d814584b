/* CRC-16-CCITT-FALSE without a table: the polynomial x^16 + x^12 + x^5 + 1 is so sparse that a byte at a time is three
 * shifts. */
#include "evstim.h"

uint16_t evstim_crc16(uint16_t crc, const uint8_t *bytes, size_t n)
{
    uint32_t register_ = crc;
    for (size_t i = 0; i < n; i++) {
        uint32_t x = (register_ >> 8 ^ bytes[i]) & 0xFFu;
        x ^= x >> 4;
        register_ = (register_ << 8 ^ x << 12 ^ x << 5 ^ x) & 0xFFFFu;
    }
    return (uint16_t)register_;
}
