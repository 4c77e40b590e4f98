// A linear layer for one CPU thread and inference, in what products are in: see products.h and tiles.h.

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

// out (rows, out_width) = x W^T + bias, and its positive part if `relu`. x (rows, width), `stride` floats from one row
// to the next; `packed` is W by straightpcf_pack; width and out_width are multiples of 32.
void straightpcf_linear(const float* x, int stride, const float* packed_, const float* bias, int rows, int width,
                        int out_width, int relu, float* out) {
  const element* packed = reinterpret_cast<const element*>(packed_);
  std::vector<element> scratch((size_t)BLOCK * width + 64);
  element* block = reinterpret_cast<element*>((reinterpret_cast<uintptr_t>(scratch.data()) + 63) / 64 * 64);
  alignas(64) float sums[BLOCK * BLOCK];
#if defined(__AMX_BF16__)
  configure_tiles();
#endif
  for (int first = 0; first < rows; first += BLOCK) {
    const int here = std::min(BLOCK, rows - first);
    for (int n = 0; n < here; ++n)
      for (int d = 0; d < width; d += LANES) {
#if defined(__AMX_BF16__)
        element* to = block + (size_t)(d / DEPTH * BLOCK + n) * DEPTH + d % DEPTH;
#else
        element* to = block + (size_t)n * width + d;
#endif
        put(to, load(x + (size_t)(first + n) * stride + d));
      }
    for (int c0 = 0; c0 < out_width; c0 += BLOCK) {
      const element* columns = packed + (size_t)c0 * width;
#if defined(__AMX_BF16__)
      clear_sums();
      add_products(block, columns, width);
      store_sums(sums, BLOCK);
#else
      constexpr int ROWS = 8, COLS = BLOCK / LANES;
      for (int n = 0; n < here; n += ROWS) {
        vec sum[ROWS][COLS];
        products<ROWS, COLS>(block + (size_t)n * width, width, columns, sum);
        for (int r = 0; r < ROWS; ++r)
          for (int c = 0; c < COLS; ++c) store(sums + (n + r) * BLOCK + c * LANES, sum[r][c]);
      }
#endif
      finish(sums, bias + c0, here, out_width, relu != 0, out + (size_t)first * out_width + c0);
    }
  }
#if defined(__AMX_BF16__)
  _tile_release();
#endif
}

}  // extern "C"
