// A linear layer in bfloat16 with float32 sums on AMX's tiles, for one CPU thread and inference. Elsewhere torch does
// it in float32: see `linear` in model/ops.py.

#include "tiles.h"
#include "vectors.h"

#if defined(__AMX_BF16__)

extern "C" {

// out (rows, out_width) = x (rows, width) W^T + bias, and its positive part if `relu`; `packed` is W by pack,
// bias may be null; width and out_width are multiples of 32.
void straightpcf_linear(const float* x, const float* packed, const float* bias, int rows, int width, int out_width,
                        int relu, float* out) {
  std::vector<uint16_t> scratch((size_t)2 * TILE * width + DEPTH);
  uint16_t* block = reinterpret_cast<uint16_t*>((reinterpret_cast<uintptr_t>(scratch.data()) + 63) / 64 * 64);
  alignas(64) float sums[2 * TILE * 2 * LANES];
  const __m512 least = _mm512_set1_ps(relu ? 0.0f : -3.4e38f);
  configure_tiles();
  for (int first = 0; first < rows; first += 2 * TILE) {
    const int here = std::min(2 * TILE, rows - first);
    for (int n = 0; n < here; ++n)
      for (int d = 0; d < width; d += DEPTH) {
        const float* from = x + (size_t)(first + n) * width + d;
        const __m512bh pair = _mm512_cvtne2ps_pbh(_mm512_loadu_ps(from + LANES), _mm512_loadu_ps(from));
        _mm512_store_si512(block + (size_t)(d / DEPTH * 2 * TILE + n) * DEPTH, (__m512i)pair);
      }
    for (int c0 = 0; c0 < out_width; c0 += 2 * LANES) {
      clear_sums();
      add_products(block, reinterpret_cast<const uint16_t*>(packed) + (size_t)c0 * width, width);
      store_sums(sums, 2 * LANES);
      for (int c = 0; c < 2 * LANES; c += LANES) {
        const __m512 offset = bias ? _mm512_loadu_ps(bias + c0 + c) : _mm512_setzero_ps();
        for (int n = 0; n < here; ++n) {
          const __m512 sum = _mm512_add_ps(_mm512_load_ps(sums + n * 2 * LANES + c), offset);
          _mm512_storeu_ps(out + (size_t)(first + n) * out_width + c0 + c, _mm512_max_ps(sum, least));
        }
      }
    }
  }
  _tile_release();
}

}  // extern "C"

#endif
