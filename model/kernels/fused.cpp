// A whole VelocityModule or DistanceModule on one patch, for one CPU thread and inference: called once where torch
// would be some forty operations, each of which asks for the interpreter's lock, for which threads then wait. Its twin
// is the module's own forward (model/nets/).

#include "kernels.h"
#include "vectors.h"

namespace {

constexpr int WIDE = 32;  // every width is filled up to a multiple with zeros, of weights too
inline int wide(int width) { return (width + WIDE - 1) / WIDE * WIDE; }

// Buffers that a thread keeps from patch to patch.
class Buffers {
 public:
  explicit Buffers(size_t floats) {
    if (kept_.size() < floats + 16) kept_.resize(floats + 16);
    next_ = aligned(kept_.data());
  }
  float* take(size_t floats) {  // a multiple of a cache line at a time keeps them aligned
    float* here = next_;
    next_ += (floats + 15) / 16 * 16;
    return here;
  }

 private:
  static thread_local std::vector<float> kept_;
  float* next_;
};
thread_local std::vector<float> Buffers::kept_;

// The weights of an EdgeConv, in the order in which `fused.py` lists them.
struct Block {
  const float *own, *own_bias, *other, *other_bias, *second, *second_bias, *lin, *lin_bias;
};

// A linear layer of three inputs or three outputs, in float32:
// out (rows, out_width) = x (rows, width) weight (width, out_width) + bias.
void exact(const float* x, int stride, const float* weight, const float* bias, int rows, int width, int out_width,
           float* out) {
  for (int i = 0; i < rows; ++i)
    for (int c = 0; c < out_width; c += LANES) {
      vec sum = load(bias + c);
      for (int d = 0; d < width; ++d)
        sum += splat(x[(size_t)i * stride + d]) * load(weight + (size_t)d * out_width + c);
      store(out + (size_t)i * out_width + c, sum);
    }
}

// The per-point layers of a block, of positions (width 3) or of features.
void layer(const float* x, int stride, const float* weight, const float* bias, int rows, int width, int out_width,
           float* out) {
  if (width < WIDE)
    exact(x, stride, weight, bias, rows, width, out_width, out);
  else
    straightpcf_linear(x, stride, weight, bias, rows, width, out_width, 0, out);
}

// out (rows, out_stride) = max_j MLP([x_i, x_j - x_i]) + Lin(x_i), x (count, stride), by the graph of `features`.
// The last block has no activation, and no graph that an error would change.
void edge_conv(const float* x, int count, int stride, int width, const float* features, int dims, int rows, int k,
               const Block& w, int out_width, bool last, float* a, float* b, float* edges, int32_t* index,
               float* out, int out_stride) {
  straightpcf_knn(features, count, dims, rows, k, index);
  layer(x, stride, w.own, w.own_bias, rows, width, out_width, a);
  layer(x, stride, w.other, w.other_bias, count, width, out_width, b);
  if (last)
    straightpcf_edge_max_coarse(a, b, index, w.second, rows, count, k, out_width, out_width, edges);
  else
    straightpcf_edge_max_fine(a, b, index, w.second, rows, count, k, out_width, out_width, edges);
  layer(x, stride, w.lin, w.lin_bias, rows, width, out_width, a);
  const vec least = splat(last ? -3.4e38f : 0.0f);
  for (int i = 0; i < rows; ++i)
    for (int c = 0; c < out_width; c += LANES) {
      const vec edge = load(edges + (size_t)i * out_width + c) + load(w.second_bias + c);
      const vec skip = load(a + (size_t)i * out_width + c);
      store(out + (size_t)i * out_stride + c, (edge > least ? edge : least) + (skip > least ? skip : least));
    }
}

}  // namespace

extern "C" {

// x (count, 3), count > 1; out (rows, widths[5]), or (1, widths[5]) with `pool`. layers: the weights of three blocks
// and the decoder's three layers with their biases, batch norms folded in; widths: of the blocks, then of the layers.
void straightpcf_fused(const float* x, int count, int rows, int k, const float* const* layers, const int32_t* widths,
                       int pool, float* out) {
  const int first = wide(widths[0]), second = wide(widths[1]), third = wide(widths[2]), joined = first + second;
  const int hidden = wide(widths[3]), last = wide(widths[4]), outputs = wide(widths[5]);
  const int widest = std::max(std::max(first, second), std::max(third, hidden));
  const size_t points = count, each = points * widest;
  Buffers buffers(points * (joined + std::max(first, second) + k) + 4 * each + 8 * 16);
  float *both = buffers.take(points * joined);
  float *features = buffers.take(points * std::max(first, second));
  float *a = buffers.take(each), *b = buffers.take(each), *edges = buffers.take(each), *whole = buffers.take(each);
  int32_t* index = reinterpret_cast<int32_t*>(buffers.take(points * k));
  Block blocks[3];
  std::memcpy(blocks, layers, sizeof blocks);
  const float* const* decoder = layers + sizeof blocks / sizeof(float*);

  edge_conv(x, count, 3, 3, x, 3, count, k, blocks[0], first, false, a, b, edges, index, both, joined);
  for (int i = 0; i < count; ++i)
    std::memcpy(features + (size_t)i * first, both + (size_t)i * joined, first * sizeof(float));
  edge_conv(both, count, joined, first, features, first, count, k, blocks[1], second, false, a, b, edges, index,
            both + first, joined);
  for (int i = 0; i < count; ++i)
    std::memcpy(features + (size_t)i * second, both + (size_t)i * joined + first, second * sizeof(float));
  edge_conv(both, count, joined, joined, features, second, rows, k, blocks[2], third, true, a, b, edges, index, whole,
            third);

  straightpcf_linear(whole, third, decoder[0], decoder[1], rows, third, hidden, 1, a);
  straightpcf_linear(a, hidden, decoder[2], decoder[3], rows, hidden, last, 1, b);
  if (pool)
    for (int i = 1; i < rows; ++i)
      for (int c = 0; c < last; ++c) b[c] = std::max(b[c], b[(size_t)i * last + c]);
  const int left = pool ? 1 : rows;
  exact(b, last, decoder[4], decoder[5], left, last, outputs, a);
  for (int i = 0; i < left; ++i)
    std::memcpy(out + (size_t)i * widths[5], a + (size_t)i * outputs, widths[5] * sizeof(float));
}

}  // extern "C"
