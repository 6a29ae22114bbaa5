# Top: samples of ddq1 of the unicycle over its heading, before and after conditioning. Bottom: the unconstrained acceleration.
set multiplot layout 2, 2 margins 0.07, 0.98, 0.11, 0.93 spacing 0.08, 0.20
set grid lc rgb '#eeeeee'
file = dir . '/fig3b_samples.csv'
set xlabel 'q3 [°]'
set ylabel 'ddq1 [m/s²]'
set xtics 90
set xrange [-180:180]
set title 'samples before conditioning' noenhanced
unset key
plot for [s=1:8] file using (column('q3')*180/pi):(column(sprintf('prior_sample%d', s))) with lines lw 1.3
set title 'samples given the data' noenhanced
set key top right opaque
plot file using (column('q3')*180/pi):'ddq1_truth' with lines lw 4 lc rgb '#cccccc' title 'truth', \
     for [s=1:8] file using (column('q3')*180/pi):(column(sprintf('posterior_sample%d', s))) with lines lw 1.3 notitle
set xtics autofreq
set xrange [-2:2]
set xlabel 'q1 [m]'
set ylabel 'ā3 [m/s²]'
set title 'surface at rest: gravity' noenhanced
set yrange [-10.05:-9.65]
file = dir . '/fig3b_abar_surface.csv'
plot file using 'q1':(column('abar_q3') - 2*column('abar_q3_std')):(column('abar_q3') + 2*column('abar_q3_std')) with filledcurves fs solid 0.6 noborder lc rgb '#9ecae1' title '± 2 std', \
     file using 'q1':'abar_q3_truth' with lines lw 3 lc rgb '#bbbbbb' title 'truth', \
     file using 'q1':'abar_q3' with lines lw 1.5 lc rgb '#08306b' dt 2 title 'GP²'
set xrange [0:1]
set xlabel 'speed [m/s]'
set ylabel 'ā1 [m/s²]'
set title 'unicycle without input: damping' noenhanced
set yrange [*:*]
file = dir . '/fig3b_abar_unicycle.csv'
plot file using 'dq1':(column('abar_q1') - 2*column('abar_q1_std')):(column('abar_q1') + 2*column('abar_q1_std')) with filledcurves fs solid 0.6 noborder lc rgb '#9ecae1' title '± 2 std', \
     file using 'dq1':'abar_q1_truth' with lines lw 3 lc rgb '#bbbbbb' title 'truth', \
     file using 'dq1':'abar_q1' with lines lw 1.5 lc rgb '#08306b' dt 2 title 'GP²'
unset multiplot
