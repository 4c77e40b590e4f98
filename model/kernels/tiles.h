// AMX: products of 32 bfloat16 rows with 32 columns, summed in float32, in the eight tile registers of a thread.
#pragma once

#include "vectors.h"

#if defined(__AMX_BF16__)

namespace {

constexpr int TILE = 16, DEPTH = 32;  // rows of a tile; bf16 of a row, which is also 16 channels of two

// Registers 0 to 3 are sums, 4 and 5 rows, 6 and 7 columns, all of 16 times 64 bytes. They are a thread's own.
inline void configure_tiles() {
  struct alignas(64) {
    uint8_t palette = 1, start = 0, reserved[14] = {};
    uint16_t bytes[16] = {};
    uint8_t rows[16] = {};
  } tiles;
  for (int t = 0; t < 8; ++t) { tiles.bytes[t] = 64; tiles.rows[t] = TILE; }
  _tile_loadconfig(&tiles);
}

// 32 floats as bf16, and what that leaves of them.
struct Rounded {
  __m512i high, low;
  Rounded(__m512 first, __m512 second) : high((__m512i)_mm512_cvtne2ps_pbh(second, first)) {
    const __m512i even = _mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm512_castsi512_si256(high)), 16);
    const __m512i odd = _mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm512_extracti64x4_epi64(high, 1)), 16);
    first = _mm512_sub_ps(first, _mm512_castsi512_ps(even));
    second = _mm512_sub_ps(second, _mm512_castsi512_ps(odd));
    low = (__m512i)_mm512_cvtne2ps_pbh(second, first);
  }
};

// 32 values of one column, a pair to a row, into their tile.
inline void scatter_column(uint16_t* to, __m512i values) {
  const __m512i rows = _mm512_setr_epi32(0, 16, 32, 48, 64, 80, 96, 112, 128, 144, 160, 176, 192, 208, 224, 240);
  _mm512_i32scatter_epi32(to, rows, values, 4);
}

// One step of a product: two tiles of rows and two of columns, `gap` apart, are multiplied and added to the sums.
inline void load_rows(const uint16_t* tiles, size_t gap) {
  _tile_loadd(4, tiles, 64);
  _tile_loadd(5, tiles + gap, 64);
}
inline void load_columns(const uint16_t* tiles, size_t gap) {
  _tile_loadd(6, tiles, 64);
  _tile_loadd(7, tiles + gap, 64);
}
inline void multiply() {
  _tile_dpbf16ps(0, 4, 6);
  _tile_dpbf16ps(1, 4, 7);
  _tile_dpbf16ps(2, 5, 6);
  _tile_dpbf16ps(3, 5, 7);
}
// The same where a number is the sum of two bfloat16: the tiles of the low parts lie behind those of the high ones.
inline void add_split_products(const uint16_t* rows, size_t row_low, size_t row_gap, const uint16_t* columns,
                               size_t column_low, size_t column_gap) {
  load_rows(rows + row_low, row_gap);
  load_columns(columns, column_gap);
  multiply();
  load_rows(rows, row_gap);
  multiply();
  load_columns(columns + column_low, column_gap);
  multiply();
}
// Adds 32 rows, as tiles of 32 channels beside each other, times 32 columns packed by straightpcf_pack.
inline void add_products(const uint16_t* rows, const uint16_t* columns, int width) {
  for (int d = 0; d < width; d += DEPTH, rows += 2 * TILE * DEPTH, columns += DEPTH * LANES) {
    load_rows(rows, TILE * DEPTH);
    load_columns(columns, (size_t)LANES * width);
    multiply();
  }
}
inline void clear_sums() { _tile_zero(0); _tile_zero(1); _tile_zero(2); _tile_zero(3); }
inline void store_sums(float* out, size_t width) {  // 32 rows of a matrix of `width` columns
  _tile_stored(0, out, width * sizeof(float));
  _tile_stored(1, out + TILE, width * sizeof(float));
  _tile_stored(2, out + TILE * width, width * sizeof(float));
  _tile_stored(3, out + TILE * width + TILE, width * sizeof(float));
}

}  // namespace

#endif
