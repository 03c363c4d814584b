/* CRC-16-CCITT-FALSE without a table: the polynomial x^16 + x^12 + x^5 + 1 is so sparse that a byte at a time is three
 * shifts. CRC-32C (polynomial 0x1EDC6F41, reflected) four bytes at a time, from a table for each four bits: a CRC is
 * linear. */
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

/* What four bits of a word add, 32 steps on, from the lowest four. */
static const uint32_t parts[8][16] = {
    {
        0x00000000u, 0xDD45AAB8u, 0xBF672381u, 0x62228939u, 0x7B2231F3u, 0xA6679B4Bu, 0xC4451272u, 0x1900B8CAu,
        0xF64463E6u, 0x2B01C95Eu, 0x49234067u, 0x9466EADFu, 0x8D665215u, 0x5023F8ADu, 0x32017194u, 0xEF44DB2Cu,
    },
    {
        0x00000000u, 0xE964B13Du, 0xD725148Bu, 0x3E41A5B6u, 0xABA65FE7u, 0x42C2EEDAu, 0x7C834B6Cu, 0x95E7FA51u,
        0x52A0C93Fu, 0xBBC47802u, 0x8585DDB4u, 0x6CE16C89u, 0xF90696D8u, 0x106227E5u, 0x2E238253u, 0xC747336Eu,
    },
    {
        0x00000000u, 0xA541927Eu, 0x4F6F520Du, 0xEA2EC073u, 0x9EDEA41Au, 0x3B9F3664u, 0xD1B1F617u, 0x74F06469u,
        0x38513EC5u, 0x9D10ACBBu, 0x773E6CC8u, 0xD27FFEB6u, 0xA68F9ADFu, 0x03CE08A1u, 0xE9E0C8D2u, 0x4CA15AACu,
    },
    {
        0x00000000u, 0x70A27D8Au, 0xE144FB14u, 0x91E6869Eu, 0xC76580D9u, 0xB7C7FD53u, 0x26217BCDu, 0x56830647u,
        0x8B277743u, 0xFB850AC9u, 0x6A638C57u, 0x1AC1F1DDu, 0x4C42F79Au, 0x3CE08A10u, 0xAD060C8Eu, 0xDDA47104u,
    },
    {
        0x00000000u, 0x13A29877u, 0x274530EEu, 0x34E7A899u, 0x4E8A61DCu, 0x5D28F9ABu, 0x69CF5132u, 0x7A6DC945u,
        0x9D14C3B8u, 0x8EB65BCFu, 0xBA51F356u, 0xA9F36B21u, 0xD39EA264u, 0xC03C3A13u, 0xF4DB928Au, 0xE7790AFDu,
    },
    {
        0x00000000u, 0x3FC5F181u, 0x7F8BE302u, 0x404E1283u, 0xFF17C604u, 0xC0D23785u, 0x809C2506u, 0xBF59D487u,
        0xFBC3FAF9u, 0xC4060B78u, 0x844819FBu, 0xBB8DE87Au, 0x04D43CFDu, 0x3B11CD7Cu, 0x7B5FDFFFu, 0x449A2E7Eu,
    },
    {
        0x00000000u, 0xF26B8303u, 0xE13B70F7u, 0x1350F3F4u, 0xC79A971Fu, 0x35F1141Cu, 0x26A1E7E8u, 0xD4CA64EBu,
        0x8AD958CFu, 0x78B2DBCCu, 0x6BE22838u, 0x9989AB3Bu, 0x4D43CFD0u, 0xBF284CD3u, 0xAC78BF27u, 0x5E133C24u,
    },
    {
        0x00000000u, 0x105EC76Fu, 0x20BD8EDEu, 0x30E349B1u, 0x417B1DBCu, 0x5125DAD3u, 0x61C69362u, 0x7198540Du,
        0x82F63B78u, 0x92A8FC17u, 0xA24BB5A6u, 0xB21572C9u, 0xC38D26C4u, 0xD3D3E1ABu, 0xE330A81Au, 0xF36E6F75u,
    },
};

uint32_t evstim_crc32c(uint32_t crc, const uint8_t *bytes, size_t n)
{
    uint32_t x = ~crc;
    for (; n >= 4; n -= 4, bytes += 4) {
        x ^= bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
        x = parts[0][x & 15u] ^ parts[1][x >> 4 & 15u] ^ parts[2][x >> 8 & 15u] ^ parts[3][x >> 12 & 15u]
            ^ parts[4][x >> 16 & 15u] ^ parts[5][x >> 20 & 15u] ^ parts[6][x >> 24 & 15u] ^ parts[7][x >> 28];
    }
    for (; n > 0; n--, bytes++) {
        x ^= *bytes;
        x = x >> 8 ^ parts[6][x & 15u] ^ parts[7][x >> 4 & 15u];
    }
    return ~x;
}
