/* CRC-16-CCITT-FALSE without a table: the polynomial x^16 + x^12 + x^5 + 1 is so sparse that a byte at a time is three
 * shifts. CRC-32C (polynomial 0x1EDC6F41, reflected) from two tables, one for each half of a byte: a CRC is linear. */
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

/* What the lower and the upper four bits of a byte add. */
static const uint32_t low_part[16] = {
    0x00000000u, 0xF26B8303u, 0xE13B70F7u, 0x1350F3F4u, 0xC79A971Fu, 0x35F1141Cu,
    0x26A1E7E8u, 0xD4CA64EBu, 0x8AD958CFu, 0x78B2DBCCu, 0x6BE22838u, 0x9989AB3Bu,
    0x4D43CFD0u, 0xBF284CD3u, 0xAC78BF27u, 0x5E133C24u,
};
static const uint32_t high_part[16] = {
    0x00000000u, 0x105EC76Fu, 0x20BD8EDEu, 0x30E349B1u, 0x417B1DBCu, 0x5125DAD3u,
    0x61C69362u, 0x7198540Du, 0x82F63B78u, 0x92A8FC17u, 0xA24BB5A6u, 0xB21572C9u,
    0xC38D26C4u, 0xD3D3E1ABu, 0xE330A81Au, 0xF36E6F75u,
};

uint32_t evstim_crc32c(uint32_t crc, const uint8_t *bytes, size_t n)
{
    uint32_t register_ = ~crc;
    for (size_t i = 0; i < n; i++) {
        uint32_t x = register_ ^ bytes[i];
        register_ = register_ >> 8 ^ low_part[x & 15u] ^ high_part[x >> 4 & 15u];
    }
    return ~register_;
}
