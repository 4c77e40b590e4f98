// A linear layer for one CPU thread and inference, to float32's precision: in float32, or on AMX's tiles, where a
// number is the sum of two bfloat16, and of the four products of two such sums the smallest is left out.

#include "kernels.h"
#include "products.h"
#include "tiles.h"
#include "vectors.h"

namespace {

constexpr int BLOCK = 32;  // rows, and channels, that are multiplied at a time

// 32 sums of each of some rows, with the bias, to their place.
inline void finish(const float* sums, const float* bias, int rows, int out_width, bool relu, float* out) {
  for (int c = 0; c < BLOCK; c += LANES) {
    const vec offset = load(bias + c);
    for (int n = 0; n < rows; ++n) {
      vec v = load(sums + n * BLOCK + c) + offset;
      if (relu) v = v > 0 ? v : vec{};
      store(out + (size_t)n * out_width + c, v);
    }
  }
}

}  // namespace

extern "C" {

// W (out_width, width) -> packed for linear, as many floats; both are multiples of 32.
void straightpcf_pack_linear(const float* weight, int width, int out_width, float* packed) {
#if defined(__AMX_BF16__)
  // Of 16 columns and 32 channels one tile of the high parts, then one of the low ones.
  uint16_t* tiles = reinterpret_cast<uint16_t*>(packed);
  for (int c = 0; c < out_width; ++c)
    for (int d = 0; d < width; d += DEPTH) {
      const float* from = weight + (size_t)c * width + d;
      const Rounded parts(_mm512_loadu_ps(from), _mm512_loadu_ps(from + LANES));
      uint16_t* to = tiles + ((size_t)(c / TILE) * width + d) * 2 * TILE + c % TILE * 2;
      scatter_column(to, parts.high);
      scatter_column(to + TILE * DEPTH, parts.low);
    }
#else
  pack_floats(weight, width, out_width, packed);
#endif
}

// out (rows, out_width) = x W^T + bias, and its positive part if `relu`. x (rows, width), `stride` floats from one row
// to the next; `packed` is W by straightpcf_pack_linear; width and out_width are multiples of 32.
void straightpcf_linear(const float* x, int stride, const float* packed, const float* bias, int rows, int width,
                        int out_width, int relu, float* out) {
  std::vector<float> scratch((size_t)BLOCK * width + 16);
  float* block = aligned(scratch.data());
  alignas(64) float sums[BLOCK * BLOCK];
#if defined(__AMX_BF16__)
  // Of 32 rows and 32 channels two tiles of the high parts, then two of the low ones.
  uint16_t* tiles = reinterpret_cast<uint16_t*>(block);
  const size_t tile = TILE * DEPTH;
  configure_tiles();
  for (int first = 0; first < rows; first += BLOCK) {
    const int here = std::min(BLOCK, rows - first);
    for (int n = 0; n < here; ++n)
      for (int d = 0; d < width; d += DEPTH) {
        const float* from = x + (size_t)(first + n) * stride + d;
        const Rounded parts(_mm512_loadu_ps(from), _mm512_loadu_ps(from + LANES));
        uint16_t* to = tiles + d / DEPTH * 4 * tile + n * DEPTH;
        _mm512_store_si512(to, parts.high);
        _mm512_store_si512(to + 2 * tile, parts.low);
      }
    for (int c0 = 0; c0 < out_width; c0 += BLOCK) {
      const uint16_t* columns = reinterpret_cast<const uint16_t*>(packed) + (size_t)c0 * 2 * width;
      const size_t gap = (size_t)2 * LANES * width;  // to the next 16 columns
      clear_sums();
      for (int d = 0; d < width; d += DEPTH) {
        const uint16_t *r = tiles + d / DEPTH * 4 * tile, *c = columns + (size_t)d / DEPTH * 2 * tile;
        add_split_products(r, 2 * tile, tile, c, tile, gap);
      }
      store_sums(sums, BLOCK);
      finish(sums, bias + c0, here, out_width, relu != 0, out + (size_t)first * out_width + c0);
    }
  }
  _tile_release();
#else
  for (int first = 0; first < rows; first += BLOCK) {
    const int here = std::min(BLOCK, rows - first);
    for (int n = 0; n < here; ++n)
      std::memcpy(block + (size_t)n * width, x + (size_t)(first + n) * stride, width * sizeof(float));
    for (int c0 = 0; c0 < out_width; c0 += BLOCK) {
      for (int c1 = 0; c1 < BLOCK; c1 += COLS * LANES)
        for (int n = 0; n < here; n += ROWS) {
          vec sum[ROWS][COLS];
          products<ROWS, COLS>(block + (size_t)n * width, width, packed + (size_t)(c0 + c1) * width, sum);
          for (int r = 0; r < ROWS; ++r)
            for (int c = 0; c < COLS; ++c) store(sums + (n + r) * BLOCK + c1 + c * LANES, sum[r][c]);
        }
      finish(sums, bias + c0, here, out_width, relu != 0, out + (size_t)first * out_width + c0);
    }
  }
#endif
}

}  // extern "C"
